"""``fpcal sample``: draw from the posterior of a cell."""

import argparse
import contextlib
import sys

from rich.console import Console

from fpcal_bayes.cli.common import console, warn, write_result
from fpcal_bayes.cli.identify import rows_of, with_prior, with_source
from fpcal_bayes.core.files import exclusive, make_folder, require_suffix
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.posterior.checkpoint import BlockStore
from fpcal_bayes.infer.posterior.netcdf import content, data_tree, slip_probabilities, summarise, write_netcdf
from fpcal_bayes.infer.posterior.sample import identity, sample
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.posterior import posterior_table


def run(options: argparse.Namespace, cell: Cell) -> int:
    require_suffix(options.output, ".nc")
    sweeps = rows_of(options, cell)
    sweeps, prior, before = with_prior(options.prior, cell, sweeps)
    warm_up(cell)
    result = with_source(identify(cell, sweeps, prior=prior), options.file, sweeps, before)
    warn(result.warnings)
    if not result.converged:
        warn(["the posterior is not sampled, since its maximum was not found"])
        return 1

    if result.doubtful_signs and (result.problem.sweeps.group != "").any():
        warn(["rows that share a reading keep the signs that were decided: where doubtful, the draws are too narrow"])

    folder = options.output.with_name(options.output.name + ".blocks")
    store = BlockStore(folder, identity(result.problem, options.seed, options.likelihood))
    make_folder(folder)
    with exclusive(folder):
        try:
            return _sample(options, result, store)
        finally:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _sample(options: argparse.Namespace, result: Identification, store: BlockStore) -> int:
    if not options.resume:
        store.clear()
    with Console(stderr=True, quiet=options.quiet or not sys.stderr.isatty()).status("sampling") as status:

        def show(effective: float, share: float) -> None:
            status.update(f"sampling: {effective:.0f} effective draws, {100 * share:.0f} %")

        posterior = sample(
            result, draws=options.draws, likelihood=options.likelihood, seed=options.seed, store=store, progress=show
        )

    command = f"fpcal sample --draws {options.draws} --seed {options.seed}"
    write_netcdf(data_tree(posterior, seed=options.seed, command=command), options.output)
    write_result(options.json, "sample", content(posterior))
    out = console(options)
    title = f"{options.file}, session {','.join(result.problem.sweeps.sessions)}: posterior"
    out.print(posterior_table(summarise(posterior), posterior.identification.free, title))
    diagnostics = posterior.diagnostics
    out.say(
        f"sampler: {posterior.log_density.size} draws in {posterior.seconds:.1f} s, acceptance "
        f"{100 * posterior.acceptance:.0f} %, effective {diagnostics.effective:.0f} or more, nested R-hat at most "
        f"{diagnostics.rhat.max():.4f}, charts {posterior.charts}, outside them "
        f"{100 * posterior.outside:.2g} %"
    )
    noise = posterior.target.noise_factors(posterior.points)
    if noise is not None:
        out.say(f"noise: {noise.mean():.3f} +- {noise.std():.3f} times the stated")
    slips = slip_probabilities(posterior)
    if slips is not None:
        likely = [f"{label} ({100 * p:.1f} %)" for label, p in slips if p > 0.5]
        out.say(f"slipped sweeps: {', '.join(likely) or 'none'}")
    warn([posterior.misfit] if posterior.misfit else [])
    warn(f"not converged: {text}; try fewer --draws or more informative sweeps" for text in posterior.failures)
    store.clear()
    return 0 if posterior.converged else 1
