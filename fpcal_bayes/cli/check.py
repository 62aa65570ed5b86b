"""``fpcal check``: is the calibration still right, by a path recorded on the cell itself."""

import argparse

import numpy as np

from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.path_check import check, check_rows
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.tasks.source import read_estimate_draws
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import write_sweeps
from fpcal_bayes.io.traces import read_path_trace
from fpcal_bayes.model.air_index import ciddor
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.report.check import check_content, check_sentences, check_warnings
from fpcal_bayes.tracking.drift import DriftModel


def run(options: argparse.Namespace, cell: Cell) -> int:
    if options.output is None and options.points is not None:
        raise InputError("--points: is taken with -o only")
    index = _index(options, cell)
    estimate, draws = read_estimate(options.estimate, cell), read_estimate_draws(options.estimate, cell)
    trace = read_path_trace(options.trace, cell)
    warm_up(cell)
    found = check(
        estimate,
        trace,
        draws=None if draws is None else draws.values,
        drift=_drift(options, cell, estimate),
        index=index,
        level=options.level,
        seed=options.seed,
    )
    tolerance = None if options.tolerance_nm is None else 1e-3 * options.tolerance_nm
    warnings = check_warnings(found) + estimate.trust.texts
    if options.output is not None and found.verdict != "not evaluated":
        points, time_h = options.points or 0, estimate.time_h if options.time_h is None else options.time_h
        rows = check_rows(estimate, trace, found.measured, session=options.session, time_h=time_h, points=points)
        write_sweeps(options.output, rows, cell, command="fpcal check")
    elif options.output is not None:
        warnings.append(f"{options.output} is not written: the check was not evaluated")
    content = {"check": check_content(found, tolerance), "warnings": warnings}
    write_result(options.json, "check", {**estimate.content(), **content})
    show(options, check_sentences(found, tolerance), warnings)
    return 0


def _index(options: argparse.Namespace, cell: Cell) -> float:
    air = (options.temperature_c, options.pressure_hpa, options.humidity_pct)
    if all(value is None for value in air):
        return 1.0
    if any(value is None for value in air):
        raise InputError("--temperature-c, --pressure-hpa, --humidity-pct: expected all three or none")
    return float(ciddor(cell.wavelength, *air))


def _drift(options: argparse.Namespace, cell: Cell, estimate: Estimate) -> Floats | None:
    """Covariance of the drift from the time of the estimate to that of the check."""
    if options.time_h is None or not cell.drift:
        return None
    hours = options.time_h - estimate.time_h
    if not 0.0 <= hours < 1e6:
        what = f"--time-h {options.time_h:g}: expected a time after that of the estimate, {estimate.time_h:g} h"
        raise InputError(what)
    drift = DriftModel.of(cell, estimate.parameters)
    start = drift.initial(estimate.values, np.zeros_like(estimate.covariance))
    return drift.covariance(drift.propagate(*start, hours)[1])
