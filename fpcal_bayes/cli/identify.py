"""``fpcal identify``: find the parameters of a cell from a file of sweeps."""

import argparse
from dataclasses import replace
from pathlib import Path

import fpcal_bayes.analysis as analysis
import fpcal_bayes.infer as infer
import fpcal_bayes.io as io
import fpcal_bayes.report as report
from fpcal_bayes.cli.common import show, warn, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.fit.prior import bends
from fpcal_bayes.infer.posterior.draws import draws_content
from fpcal_bayes.io.estimate import read_estimate, read_estimate_rows
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.sweeps import Sweeps, pool
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.trust import KINDS
from fpcal_bayes.report.fit import fit_lines, parameter_table


def run(options: argparse.Namespace, cell: Cell) -> int:
    sweeps = rows_of(options, cell)
    start = None if options.start is None else read_estimate(options.start, cell)
    sweeps, prior, before = with_prior(options.prior, cell, sweeps)
    cell.select(options.free)
    warm_up(cell)
    # What verifies loads much that a fit does without, when it is first called.
    kept = None if options.hold_out is None else infer.kept_rows(sweeps, options.hold_out)
    used = sweeps if kept is None else sweeps.take(kept)
    found = identify(cell, used, free=options.free, start=start, hold=options.hold, prior=prior)
    result = with_source(found, options.file, sweeps, before)
    verified = {}
    if kept is not None and found.estimate.trust.usable:
        made = infer.verify(found, sweeps, kept)
        verified = {"verification": made.content()}
        trust = result.estimate.trust.because(*made.reasons)
        texts = [reason.text for reason in made.reasons]
        result = replace(result, estimate=replace(result.estimate, trust=trust), warnings=(*result.warnings, *texts))

    if options.json is not None:
        draws = draws_content(result)
        write_result(options.json, "identify", {**result.content(), **draws, **verified})
        warn(draws.get("warnings", [])[-1:])
    title = f"{options.file}, session {','.join(sweeps.sessions)}: {counted(len(result.problem.sweeps), 'row')}"
    lines = [*fit_lines(result), *(report.verification_lines(made) if verified else [])]
    show(options, [parameter_table(result.estimate, title), *lines], result.warnings)
    return 0 if result.converged else 1


def rows_of(options: argparse.Namespace, cell: Cell) -> Sweeps:
    """The rows of the session that is asked for; with ``--traces`` what its recordings say."""
    if not options.traces:
        return read_sweeps(options.file, cell).of_session(options.session)
    warm_up(cell)
    # What reads traces loads much that rows do without, when it is first called.
    rows, warnings = analysis.trace_rows(cell, io.read_recordings(options.file, cell), session=options.session)
    warn(warnings)
    return rows  # type: ignore[no-any-return]


def with_prior(path: str | None, cell: Cell, sweeps: Sweeps) -> tuple[Sweeps, Estimate | None, Estimate | None]:
    """The sweeps with those of an earlier estimate, whose surface bends, and that estimate; or it as a normal prior."""
    if path is None:
        return sweeps, None, None
    estimate, rows = read_estimate(path, cell), read_estimate_rows(path, cell)
    if rows is not None:
        return pool([rows, sweeps]), None, estimate
    if bends(estimate):
        raise InputError(
            f"{path}: key rows: none are there, and values with covariance do not say what sweeps said; expected an "
            "estimate that fpcal identify made of an unchanged cell (fpcal track follows one that drifts), or both "
            "sessions in one file with --session a,b"
        )
    return sweeps, estimate, None


def with_source(result: Identification, file: str, sweeps: Sweeps, before: Estimate | None = None) -> Identification:
    """The result with its file, hash and sessions, and with what forbids the use of `before`, whose sweeps it took."""
    data = {"file": Path(file).name, "sha256": file_sha256(Path(file)), "session": ",".join(sweeps.sessions)}
    found = replace(result.estimate, data=data)
    against = [r for r in (() if before is None else before.trust.reasons) if KINDS[r.kind]]
    new = [r.text for r in against if r not in found.trust.reasons]
    found = replace(found, trust=found.trust.because(*against))
    return replace(result, estimate=found, warnings=(*result.warnings, *new))
