"""``fpcal study``: thousands of independent calibrations, on this machine or on a cluster."""

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from fpcal_bayes.cli.common import Output, cell_of, check_outputs, console, warn, write_result
from fpcal_bayes.cli.driven import goal_of, warm_up_inverse
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.protocol import PROTOCOLS, protocol_by_name, read_often
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.report.table import plain_table
from fpcal_bayes.study.base import Study, Summary
from fpcal_bayes.study.coverage import Coverage
from fpcal_bayes.study.drifting_week import Setting
from fpcal_bayes.study.planning import Planning
from fpcal_bayes.study.policies import DEFAULT_POLICIES, Policies, rules
from fpcal_bayes.study.runner import Progress, run_on_cluster
from fpcal_bayes.study.sbc import RANKED, PosteriorRanks, sbc_plan
from fpcal_bayes.study.store import StudyStore

#: Seconds between two lines about the progress where there is no terminal.
_BETWEEN_LINES = 30.0


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    stated = cell_of(options)
    # A study draws its truths from the priors of the parameters: its mechanism is perfect, whatever the cell states.
    cell = stated.ideal
    output: Path = options.output or Path(f"study-{options.study}.h5")
    options.output = output
    check_outputs(options)
    if options.scheduler is not None and options.workers is not None:
        raise InputError("--workers: expected without --scheduler, whose workers are there already")
    workers = options.workers or _cores()
    study = _MAKERS[options.study](options, cell)
    warm_up_inverse(cell)

    store = StudyStore(output, study)
    with _Reporter(options) as reporter:
        state = run_on_cluster(
            study,
            store,
            options.replicates,
            workers=workers,
            scheduler=options.scheduler,
            anew=options.anew,
            progress=reporter.show,
        )
    summary = study.summary(store.results(options.replicates))
    if stated.mechanics is not None:
        summary.warnings.append(
            "the mechanism of this study is perfect whatever the cell states: studies/mechanics_coverage.py has others"
        )
    content = {
        "cell": {"name": cell.name, "sha256": cell.sha256},
        "study": study.name,
        "replicates": options.replicates,
        "settings": study.settings() | {"seed": study.seed},
        "rows": summary.rows,
        "sentences": summary.sentences,
        "warnings": summary.warnings,
    }
    write_result(options.json, "study", content, Trust())
    out = console(options)
    _print(summary, out)
    known = options.replicates - state.came
    out.say(f"{state.came} replicates in {state.seconds:.1f} s, {known} were there before -> {output}")
    warn(summary.warnings)
    return 0


def _cores() -> int:
    """How many cores this process may use; where the system does not tell, all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _print(summary: Summary, out: Output) -> None:
    if summary.rows:
        table = plain_table(summary.title, [column.replace("_", " ") for column in summary.rows[0]])
        for row in summary.rows:
            table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
        out.print(table)
    for sentence in summary.sentences:
        out.say(sentence)


def _sweeps_of(options: argparse.Namespace, cell: Cell) -> Sweeps:
    """The sweeps that ``--protocol`` names, as a plan."""
    if options.protocol in PROTOCOLS:
        return protocol_by_name(options.protocol, cell)
    return _usable(read_sweeps(options.protocol, cell, plan=True), options.protocol)


def _usable(sweeps: Sweeps, file: str) -> Sweeps:
    """Sweeps of one session without those that no calibration uses."""
    first = sweeps.of_session(None)
    kept = first.take(first.kind == "sweep")
    if not len(kept):
        raise InputError(f"{file}: expected at least one row of kind sweep")
    return kept


def _coverage(options: argparse.Namespace, cell: Cell) -> Study:
    plan = _sweeps_of(options, cell)
    return Coverage(cell=cell, seed=options.seed, plan=plan, sigma=1e-3 * options.sigma_nm)


def _sbc(options: argparse.Namespace, cell: Cell) -> Study:
    if options.draws <= RANKED:
        raise InputError(f"--draws {options.draws}: expected more than {RANKED}, among which the truth is ranked")
    plan = sbc_plan("random", cell) if options.protocol == "random" else _sweeps_of(options, cell)
    sigma, draws = 1e-3 * options.sigma_nm, options.draws
    return PosteriorRanks(cell=cell, seed=options.seed, plan=plan, sigma=sigma, draws=draws)


def _policy(options: argparse.Namespace, cell: Cell) -> Study:
    goal = goal_of(options, cell)
    chosen = tuple(options.policies.split(";")) if options.policies else DEFAULT_POLICIES
    known = rules(Setting(cell), goal)
    for name in chosen:
        if name not in known:
            raise InputError(f"--policies: {name!r:.60} is unknown, expected some of: {'; '.join(known)}")
    sigma, hours, harder = 1e-3 * options.sigma_nm, options.hours, options.harder
    return Policies(cell=cell, seed=options.seed, goal=goal, policies=chosen, sigma=sigma, hours=hours, harder=harder)


def _plan(options: argparse.Namespace, cell: Cell) -> Study:
    if options.plan is None:
        raise InputError("study plan: expected --plan SWEEPS, whole sweeps as fpcal plan -o writes them")
    whole = _usable(read_sweeps(options.plan, cell, plan=True, whole=True), options.plan)
    if (whole.group != "").any():
        raise InputError(f"{options.plan}: column group: expected whole sweeps without groups")
    rows = read_often(whole, options.readings)
    return Planning(cell=cell, seed=options.seed, plan=rows, sigma=1e-3 * options.sigma_nm)


_MAKERS: dict[str, Callable[[argparse.Namespace, Cell], Study]] = {
    "coverage": _coverage, "sbc": _sbc, "policy": _policy, "plan": _plan
}  # fmt: skip


class _Reporter:
    """Shows how far a study is: a bar on a terminal, else a line now and then."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._quiet = options.quiet
        self._terminal = sys.stderr.isatty()
        self._next_line = time.monotonic() + _BETWEEN_LINES
        self._bar = ProgressBar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[workers]} workers"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=self._quiet or not self._terminal,
            transient=True,
        )
        self._task = self._bar.add_task(f"study {options.study}", total=options.replicates, workers=0)

    def __enter__(self) -> "_Reporter":
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.stop()

    def show(self, state: Progress) -> None:
        """Show the state after a task."""
        self._bar.update(self._task, completed=state.done, workers=state.workers)
        if self._quiet or self._terminal or time.monotonic() < self._next_line:
            return
        self._next_line = time.monotonic() + _BETWEEN_LINES
        left = "" if state.seconds_left is None else f", {state.seconds_left / 60.0:.1f} min left"
        print(f"fpcal: {state.done} of {state.replicates} replicates, {state.workers} workers{left}", file=sys.stderr)
