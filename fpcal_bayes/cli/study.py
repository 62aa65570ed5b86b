"""``fpcal study``: thousands of independent calibrations."""

import argparse
import os
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from fpcal_bayes.cli.common import about, check_outputs, show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.protocol import PROTOCOLS, protocol_by_name
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.report.table import plain_table
from fpcal_bayes.study.base import Study
from fpcal_bayes.study.coverage import Coverage
from fpcal_bayes.study.run import run_study
from fpcal_bayes.study.sbc import RANKED, PosteriorRanks, sbc_plan

#: Each replicate has one core: libraries that start threads of their own are held to one.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


def run(options: argparse.Namespace, stated: Cell) -> int:
    # A study draws its truths from the priors of the parameters: its mechanism is perfect, whatever the cell states.
    cell = stated.ideal
    options.output = options.output or Path(f"study-{options.study}.jsonl")
    check_outputs(options)
    study = _study_of(options, cell)
    warm_up_inverse(cell)
    os.environ.update(_ONE_THREAD)
    began = time.monotonic()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    hidden = options.quiet or not sys.stderr.isatty()
    with Progress(console=Console(stderr=True), disable=hidden, transient=True) as bar:
        task = bar.add_task(f"study {study.name}", total=options.replicates)
        results, came = run_study(
            study,
            options.output,
            options.replicates,
            workers=options.workers or cores or 1,
            anew=options.anew,
            progress=lambda done: bar.update(task, completed=done),
        )
    summary = study.summary(results)
    if stated.mechanics is not None:
        summary.warnings.append(
            "the mechanism of this study is perfect whatever the cell states: studies/mechanics_coverage.py has others"
        )
    content = {
        "study": study.name,
        "replicates": options.replicates,
        "settings": study.settings() | {"seed": study.seed},
        "rows": summary.rows,
        "sentences": summary.sentences,
        "warnings": summary.warnings,
    }
    write_result(options.json, "study", about(cell) | content, Trust())
    tables = []
    if summary.rows:
        tables = [plain_table(summary.title, [column.replace("_", " ") for column in summary.rows[0]])]
        for row in summary.rows:
            tables[0].add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
    seconds, known = time.monotonic() - began, options.replicates - came
    said = f"{counted(came, 'replicate')} in {seconds:.1f} s, {known} were there before -> {options.output}"
    show(options, [*tables, *summary.sentences, said], summary.warnings)
    return 0


def _study_of(options: argparse.Namespace, cell: Cell) -> Study:
    sigma = 1e-3 * options.sigma_nm
    if options.study == "coverage":
        return Coverage(cell=cell, seed=options.seed, plan=_sweeps_of(options, cell), sigma=sigma)
    if options.draws <= RANKED:
        raise InputError(f"--draws {options.draws}: expected more than {RANKED}, among which the truth is ranked")
    plan = sbc_plan("random", cell) if options.protocol == "random" else _sweeps_of(options, cell)
    return PosteriorRanks(cell=cell, seed=options.seed, plan=plan, sigma=sigma, draws=options.draws)


def _sweeps_of(options: argparse.Namespace, cell: Cell) -> Sweeps:
    if options.protocol in PROTOCOLS:
        return protocol_by_name(options.protocol, cell)
    first = read_sweeps(options.protocol, cell, plan=True).of_session(None)
    kept = first.take(first.kind == "sweep")
    if not len(kept):
        raise InputError(f"{options.protocol}: expected at least one row of kind sweep")
    return kept
