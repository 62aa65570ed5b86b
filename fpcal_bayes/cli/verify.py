"""``fpcal verify``: hold a calibration against sweeps that it was not made from."""

import argparse
import json
import os
from pathlib import Path

import numpy as np

from fpcal_bayes.cli.common import about, show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.infer.verification.verify import verify
from fpcal_bayes.io.estimate import read_estimate, read_estimate_rows
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.sweeps import Sweeps, pool
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.verification import power_table, verification_lines
from fpcal_bayes.tracking.drift import drift_root


def run(options: argparse.Namespace, cell: Cell) -> int:
    fitted = _calibration_rows(options.file, cell)
    fresh = _fresh_rows(options, cell, fitted)
    warm_up_inverse(cell)
    found = identify(cell, fitted)
    everything = pool([found.problem.sweeps, fresh])
    is_fitted = np.arange(len(everything)) < len(found.problem.sweeps)
    hours = float(everything.time_h[~is_fitted].mean() - everything.time_h[is_fitted].mean())
    made = verify(
        found,
        everything,
        is_fitted,
        drift=drift_root(cell, found.problem.model.free, hours),
        tasks=options.task,
        tolerance=options.tolerance_nm * 1e-3,
        radius=options.radius_um,
        seed=options.seed,
    )
    estimate = found.estimate
    trust = estimate.trust.because(*made.reasons)
    content = {"time_h": estimate.time_h, "data": {"session": ",".join(fitted.sessions)}}
    content |= {"verification": made.content(), "warnings": trust.texts}
    write_result(options.json, "verify", about(estimate.cell) | content, trust)
    table = power_table(made, f"{options.file}, verified by {fresh.file}, {','.join(fresh.sessions)}")
    show(options, [table, *verification_lines(made)], trust.texts)
    return 0


def _calibration_rows(path: str, cell: Cell) -> Sweeps:
    """The rows of a calibration: those that an estimate carries, or the first session of a campaign."""
    if Path(path).suffix.lower() != ".json":
        return read_sweeps(path, cell).of_session(None)
    read_estimate(path, cell)
    rows = read_estimate_rows(path, cell)
    if rows is None:
        raise InputError(
            f"{path}: key rows: none are there, and only sweeps say how an estimate bends; expected an estimate that "
            "fpcal identify made, or the campaign itself"
        )
    if set(json.loads(Path(path).read_text())["parameters"]) != set(cell.free.names):
        raise InputError(f"{path}: some parameters were held; expected an estimate with all of them free")
    return rows


def _fresh_rows(options: argparse.Namespace, cell: Cell, fitted: Sweeps) -> Sweeps:
    """The sweeps that verify: a file of their own, or a session of the campaign."""
    name = options.validation
    if os.path.exists(name):
        fresh = read_sweeps(name, cell)
    elif Path(options.file).suffix.lower() == ".json" or Path(name).suffix:
        raise InputError(f"{name}: no such file, expected a file of sweeps")
    elif name in fitted.sessions:
        raise InputError(f"session {name!r} is the calibration itself, expected one that it was not made from")
    else:
        fresh = read_sweeps(options.file, cell).of_session(name)
    fresh = fresh.take(fresh.kind != "path")
    if len(fresh) == 0 or not fresh.measured:
        raise InputError(f"{fresh.file}: expected at least one measured sweep to verify with")
    return fresh
