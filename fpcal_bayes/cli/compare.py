"""``fpcal compare``: which of several models the data favour."""

import argparse
import sys

from rich.console import Console

from fpcal_bayes.cli.common import console, warn, write_result
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.posterior.compare import compare, parse_models
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.posterior import compare_table


def run(options: argparse.Namespace, cell: Cell) -> int:
    specs = parse_models(options.models, cell)
    sweeps = read_sweeps(options.file, cell).of_session(options.session)
    warm_up(cell)
    with Console(stderr=True, quiet=options.quiet or not sys.stderr.isatty()).status("") as status:
        comparison = compare(cell, sweeps, specs, draws=options.draws, seed=options.seed, progress=status.update)

    write_result(options.json, "compare", comparison.content(), comparison.trust)
    out = console(options)
    out.print(compare_table(comparison, f"{options.file}, session {','.join(sweeps.sessions)}: {len(sweeps)} rows"))
    out.say(f"verdict: {comparison.verdict}")
    warn(comparison.warnings)
    return 0 if comparison.sound else 1
