"""``fpcal identify``: find the parameters of a cell from a file of sweeps."""

import argparse
from dataclasses import replace
from pathlib import Path

from fpcal_bayes.analysis.traces import identify_traces
from fpcal_bayes.cli.common import cell_of, console, warn, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.posterior.draws import draws_content
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.recordings import read_recordings
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.fit import fit_lines, parameter_table


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    cell = cell_of(options)
    if options.traces:
        return _whole_traces(options, cell)
    sweeps = read_sweeps(options.file, cell).of_session(options.session)
    start = None if options.start is None else read_estimate(options.start, cell)
    prior = None if options.prior is None else read_estimate(options.prior, cell)
    cell.select(options.free)
    warm_up(cell)
    found = identify(cell, sweeps, free=options.free, start=start, hold=options.hold, prior=prior)
    result = with_source(found, options.file, sweeps.sessions[0])

    if options.json is not None:
        write_result(options.json, "identify", {**result.content(), **draws_content(result)})
    out = console(options)
    title = f"{options.file}, session {sweeps.sessions[0]}: {len(result.problem.sweeps)} rows"
    out.print(parameter_table(result.estimate, title))
    for line in fit_lines(result):
        out.say(line)
    warn(result.warnings)
    return 0 if result.converged else 1


def _whole_traces(options: argparse.Namespace, cell: Cell) -> int:
    """Every sample of the recordings in place of rows."""
    if options.start is not None:
        raise InputError("--start: is not taken with --traces, which starts from what the traces' ends identify")
    prior = None if options.prior is None else read_estimate(options.prior, cell)
    index = read_recordings(options.file, cell)
    cell.select(options.free)
    warm_up(cell)
    fit = identify_traces(cell, index, session=options.session, free=options.free, prior=prior)
    session = options.session or index.sweeps.sessions[0]
    data = {"file": Path(options.file).name, "sha256": file_sha256(Path(options.file)), "session": session}
    fit = replace(fit, estimate=replace(fit.estimate, data=data))
    if options.json is not None:
        write_result(options.json, "identify", fit.content())
    out = console(options)
    title = f"{options.file}, session {session}: {fit.n_samples} samples of {len(fit.labels)} traces"
    out.print(parameter_table(fit.estimate, title))
    out.say(f"rank {fit.rank} of {len(fit.estimate.values)}, {fit.steps} steps, {fit.seconds:.1f} s")
    warn(fit.warnings)
    return 0 if fit.converged else 1


def with_source(result: Identification, file: str, session: str) -> Identification:
    """The result with name and hash of the file, and the session, that it was made from."""
    data = {"file": Path(file).name, "sha256": file_sha256(Path(file)), "session": session}
    return replace(result, estimate=replace(result.estimate, data=data))
