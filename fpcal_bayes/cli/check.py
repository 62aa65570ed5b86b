"""``fpcal check``: is the calibration still right, by a path recorded on the cell itself."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    count,
    positive,
    seed,
    share,
    warn,
    write_result,
)
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.model.cell.cell import Cell

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fpcal_bayes.fringes.path_check import PathError
    from fpcal_bayes.measure.traces import PathTrace
    from fpcal_bayes.model.estimate import Estimate


_EPILOG = """\
TRACE is a CSV with the columns part,t_s,q1_um .. q6_deg,irradiance_v. Lines of part `reference` come first: the robot
stands at the start of the path, and the joint along the optical axis (q2) goes through one fringe or more and back.
Lines of part `path` follow: the path that the controller drove with the estimate (fpcal control). A second reference
scan after the path is welcome: it tells how the signal drifted. `fpcal simulate --path JOINTS.csv --traces` makes such
a file on the simulated cell.

Start at half fringe height (quadrature): move q2 there before the path. At the fringe's maximum 20 nm change the signal
by 0.7 % of its height only, at half height by 8 %.

A calibration is refuted if an error as large as the one measured would be less probable than --level, did the estimate
hold; what the estimate predicts is worked out from its posterior draws, or to first order from its covariance. With
--time-h the cell may have drifted since the time of the estimate as it states; without, the check asks whether the
estimate holds as it is.

-o writes the check as a row of kind `path` for a campaign: dl_um is the peak to peak of the error, signed 0. --points N
adds N sweeps from the path's start to points along it, in one group, which `fpcal track` takes in as measurements.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "check", "check a calibration by a path recorded on the cell", run, _EPILOG)
    parser.add_argument("trace", metavar="TRACE", help="recorded path: .csv")
    parser.add_argument(
        "--estimate", metavar="ESTIMATE", required=True, help="estimate JSON that the path was made with"
    )
    parser.add_argument("--tolerance-nm", type=positive, metavar="T", help="say whether the path is within T")
    parser.add_argument("--level", type=share, default=0.01, metavar="P", help="refuted below this (default: 0.01)")
    parser.add_argument(
        "--stability-percent",
        type=positive,
        default=0.5,
        metavar="P",
        help="how gain and offset may wander during the path, one standard deviation (default: 0.5)",
    )
    parser.add_argument("-o", dest="output", metavar="CHECK", type=Path, help="the check as sweeps: .csv or .h5")
    parser.add_argument("--points", type=count, metavar="N", help="with -o: sweeps to N points of the path too")
    parser.add_argument("--session", metavar="NAME", default="check", help="with -o: its session (default: check)")
    parser.add_argument(
        "--time-h", type=float, default=None, metavar="T", help="when it was recorded, in hours since day 0"
    )
    for name, unit in (("temperature-c", "C"), ("pressure-hpa", "hPa"), ("humidity-pct", "%%")):
        parser.add_argument(f"--{name}", type=float, metavar="X", help=f"of the air in {unit}; all three or none")
    parser.add_argument("--seed", type=seed, default=0, help="of the draws (default: 0)")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.fringes.path_check import check_path, measure_path
    from fpcal_bayes.infer.tasks.source import read_estimate_draws
    from fpcal_bayes.io.estimate import read_estimate
    from fpcal_bayes.io.traces import read_path_trace
    from fpcal_bayes.model.cavity import CavityModel
    from fpcal_bayes.report.check import check_content, check_sentences, check_warnings

    cell = cell_of(options)
    if options.output is None and options.points is not None:
        raise InputError("--points: is taken with -o only")
    check_output(options.output, options.trace, options.estimate)
    check_output(options.json, options.trace, options.estimate, options.output)
    index = _index(options, cell)
    estimate = read_estimate(options.estimate, cell)
    draws = read_estimate_draws(options.estimate, cell)
    trace = read_path_trace(options.trace, cell)
    warm_up(cell)
    measured = measure_path(
        cell, estimate, trace, index=index, stability=options.stability_percent / 100.0, seed=options.seed
    )
    model = CavityModel.of(cell, estimate.parameters, estimate.vector())
    check = check_path(
        measured,
        model,
        estimate.values,
        None if draws is None else draws.values,
        estimate.covariance,
        trace,
        drift=_drift(options, cell, estimate),
        level=options.level,
        seed=options.seed,
    )
    tolerance = None if options.tolerance_nm is None else 1e-3 * options.tolerance_nm
    for line in check_sentences(check, tolerance):
        console(options).print(line, soft_wrap=True, markup=False)
    warnings = check_warnings(check)
    if options.output is not None and check.verdict != "not evaluated":
        _write_rows(options, cell, estimate, trace, measured)
    elif options.output is not None:
        warnings.append(f"{options.output} is not written: the check was not evaluated")
    warn(warnings)
    content = {"check": check_content(check, tolerance), "warnings": warnings}
    write_result(options.json, "check", {**estimate.content(), **content})
    return 0


def _index(options: argparse.Namespace, cell: Cell) -> float:
    """Refractive index of the air."""
    from fpcal_bayes.model.air_index import ciddor

    air = (options.temperature_c, options.pressure_hpa, options.humidity_pct)
    if all(value is None for value in air):
        return 1.0
    if any(value is None for value in air):
        raise InputError("--temperature-c, --pressure-hpa, --humidity-pct: expected all three or none")
    return float(ciddor(cell.wavelength, *air))


def _drift(options: argparse.Namespace, cell: Cell, estimate: "Estimate") -> "NDArray[np.float64] | None":
    """Covariance of the drift from the time of the estimate to that of the check."""
    import numpy as np

    from fpcal_bayes.tracking.drift import DriftModel

    if options.time_h is None or not cell.drift:
        return None
    hours = options.time_h - estimate.time_h
    if not 0.0 <= hours < 1e6:
        raise InputError(
            f"--time-h {options.time_h:g}: expected a time after that of the estimate, {estimate.time_h:g} h"
        )
    drift = DriftModel.of(cell, estimate.parameters)
    start = drift.initial(estimate.values, np.zeros_like(estimate.covariance))
    return drift.covariance(drift.propagate(*start, hours)[1])


def _write_rows(
    options: argparse.Namespace, cell: Cell, estimate: "Estimate", trace: "PathTrace", measured: "PathError"
) -> None:
    from fpcal_bayes.fringes.path_check import check_rows
    from fpcal_bayes.io.sweeps import write_sweeps

    time_h = estimate.time_h if options.time_h is None else options.time_h
    rows = check_rows(
        cell, estimate, trace, measured, session=options.session, time_h=time_h, points=options.points or 0
    )
    write_sweeps(options.output, rows, cell, command="fpcal check")
