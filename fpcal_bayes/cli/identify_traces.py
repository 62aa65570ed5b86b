"""``fpcal identify --traces``: every sample of the recordings in place of rows."""

import argparse
from dataclasses import replace
from pathlib import Path

from fpcal_bayes.analysis.traces import identify_traces
from fpcal_bayes.cli.common import cell_of, console, warn, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.fit.prior import bends
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.recordings import read_recordings
from fpcal_bayes.report.fit import parameter_table


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    cell = cell_of(options)
    if options.start is not None:
        raise InputError("--start: is not taken with --traces, which starts from what the traces' ends identify")
    prior = None if options.prior is None else read_estimate(options.prior, cell)
    if prior is not None and bends(prior):
        raise InputError(f"{options.prior}: what sweeps said is no normal prior, expected --prior without --traces")
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
