"""``fpcal simulate``: measure sweeps on a simulated cell."""

import argparse

from fpcal_bayes.cli.common import console
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.io.joint_paths import read_joint_path
from fpcal_bayes.io.recordings import write_recordings
from fpcal_bayes.io.sweeps import read_sweeps, write_sweeps
from fpcal_bayes.io.traces import write_path_trace
from fpcal_bayes.io.truth import read_truth, write_truth
from fpcal_bayes.measure.protocol import mark_signs, protocol_by_name
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, default_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import require_task_within_envelope
from fpcal_bayes.simulator.recorder import check_recordable, record_path, record_sweeps
from fpcal_bayes.simulator.sweeps import require_drivable, simulate_um

_PROTOCOLS = ("paper", "paper-mid")
#: Standard deviation of each simulated dL where none is given.
_SIGMA_NM = 5.0


def run(options: argparse.Namespace, cell: Cell) -> int:
    _check_options(options)
    if options.traces and options.path is None:
        cell.require_one_beam("a recording of sweeps (--traces)")
    protocol = options.protocol or "paper"
    truth = default_truth(cell, options.seed) if options.truth is None else read_truth(options.truth, cell)
    if options.path is not None:
        return _record_path(options, cell, truth)
    if protocol in _PROTOCOLS:
        plan = protocol_by_name(protocol, cell)
    else:
        plan = read_sweeps(protocol, cell, plan=True, whole=options.traces)
    plan = plan if options.signs is None else mark_signs(plan, options.signs)
    require_drivable(cell, truth, plan)
    if options.traces:
        return _record(options, cell, truth, plan)
    return _measure(options, cell, truth, plan, protocol)


def _check_options(options: argparse.Namespace) -> None:
    if options.path is not None and not options.traces:
        raise InputError("--path: is taken with --traces only")
    if options.traces and options.sigma_nm is not None:
        raise InputError("--sigma-nm: is not taken with --traces, whose noise is that of the photodiode")
    if options.time_h is not None and options.path is None:
        raise InputError("--time-h: is taken with --path only; sweeps have their own times")
    for name in ("protocol", "signs"):
        if options.path is not None and getattr(options, name) is not None:
            raise InputError(f"--{name}: is not taken with --path")


def _machine(cell: Cell) -> str:
    return "" if cell.mechanics is None else ", a machine drawn from the stated error motions"


def _measure(options: argparse.Namespace, cell: Cell, truth: Truth, plan: Sweeps, protocol: str) -> int:
    warm_up(cell)
    sigma_nm = _SIGMA_NM if options.sigma_nm is None else options.sigma_nm
    sweeps = simulate_um(cell, truth, plan, sigma=sigma_nm * 1e-3, seed=options.seed)
    command = f"fpcal simulate --protocol {protocol} --sigma-nm {sigma_nm:g} --seed {options.seed}"
    command += "" if cell.mechanics is None else " --mechanics stated"
    write_sweeps(options.output, sweeps, cell, command=command, seed=options.seed, truth=truth.record())
    unsigned = int((~sweeps.signed).sum())
    signs = f", the direction of {unsigned} unknown" if unsigned else ""
    what = f"{counted(len(sweeps), 'row')} simulated on cell {cell.name!r}{_machine(cell)}"
    console(options).say(f"{what}, sd {sigma_nm:g} nm{signs} -> {options.output}")
    return 0


def _record(options: argparse.Namespace, cell: Cell, truth: Truth, plan: Sweeps) -> int:
    check_recordable(plan)
    warm_up(cell)
    index = record_sweeps(cell, truth, plan, seed=options.seed, scans=plan.signed)
    write_recordings(options.output, index, cell)
    beside = options.output.with_name(f"{options.output.stem}_truth.toml")
    write_truth(beside, truth)
    what = f"{counted(len(plan), 'sweep')} recorded on cell {cell.name!r}{_machine(cell)}"
    console(options).say(f"{what}, {sum(map(len, index.traces))} samples -> {options.output}, truth in {beside}")
    return 0


def _record_path(options: argparse.Namespace, cell: Cell, truth: Truth) -> int:
    require_suffix(options.output, ".csv")
    path = read_joint_path(options.path, cell)
    warm_up(cell)
    model, values = CavityModel.of(cell, truth.parameters), truth.at(options.time_h or 0.0)
    require_task_within_envelope(model, values, path, name=str(options.path), exact=True)
    trace = record_path(cell, truth, path, options.time_h or 0.0, seed=options.seed)
    write_path_trace(options.output, trace, cell)
    what = f"{len(trace)} samples recorded along {options.path}{_machine(cell)}"
    change = f"true change of length {1e3 * trace.length_change:.1f} nm peak to peak"
    console(options).say(f"{what}, {change} -> {options.output}")
    return 0
