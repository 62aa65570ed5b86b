"""``fpcal plan``: fewer sweeps for the same or a better accuracy of the tasks."""

import argparse
import re
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.progress import Progress

import fpcal_bayes.report as report
from fpcal_bayes.cli import plan_validation
from fpcal_bayes.cli.arguments import positive
from fpcal_bayes.cli.common import about, show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.design.candidates import SweepLimits
from fpcal_bayes.infer.design.commission import commission_plan
from fpcal_bayes.infer.design.exchange import ChosenSweeps
from fpcal_bayes.infer.design.order import duration
from fpcal_bayes.infer.design.plan import Planner, PlanSettings, Point
from fpcal_bayes.infer.design.problem import (
    DEFAULT_TASKS,
    Ground,
    estimate_ground,
    measured_estimate,
    measured_ground,
    prior_ground,
    shortfalls,
)
from fpcal_bayes.infer.fit.kernels import warm_up, warm_up_inverse
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES, read_sweeps
from fpcal_bayes.io.tickets import write_plan
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Ticket, empty_ticket
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import no_envelope_text, require_within_envelope
from fpcal_bayes.model.margin import prior_draws
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.motion.tasks import possible_tasks
from fpcal_bayes.report.plan import accuracy_table, frontier_content, plan_content, sweeps_table
from fpcal_bayes.tracking.drift import propagated

#: Draws of the prior; with mechanics the state is larger, and error motions hardly depend on the geometry.
_DRAWS, _MACHINE_DRAWS = 256, 24
#: Other draws that a plan is judged on, at most.
_CHECKED = 96
#: Seconds until the first line of progress, and between two.
_FIRST_LINE, _BETWEEN_LINES = 2.0, 5.0
#: Sweeps up to which the frontier goes at least.
_MOST_FRONTIER = 30
#: Share of a joint's range in the tasks that may lie beyond the sweeps.
_BEYOND = 0.1
_TARGET = re.compile(r"(?P<task>[^=,]+)=(?P<size>[0-9.eE+-]+)(?:nm)?")


def run(options: argparse.Namespace, cell: Cell) -> int:
    asked = any(size is not None for size in (options.n, options.reach, options.minutes))
    if asked + options.commission + (options.validation is not None) != 1:
        raise InputError("expected --n N or --reach TASK=NM,.. or --minutes M, or alone --commission or --validation N")
    targets = _targets(options.reach)
    for rows in (options.output, options.rows):
        require_suffix(rows, ".csv", *HDF5_SUFFIXES)
    for figure in (options.figure, options.frontier):
        require_suffix(figure, ".svg", ".png")
    settings = _settings(options, cell)
    if options.commission:
        return _commission(options, cell, settings)
    if options.validation is not None:
        return plan_validation.run(options, cell, settings.limits)
    options.draws = options.draws or (_DRAWS if cell.mechanics is None else _MACHINE_DRAWS)
    with _Bar(options.quiet) as bar:
        return _plan(options, cell, settings, targets, bar)


def _plan(
    options: argparse.Namespace, cell: Cell, settings: PlanSettings, targets: dict[str, float], bar: "_Bar"
) -> int:
    # Judged on other draws than those it is made for, else the figures flatter it; with targets these say how many.
    ground, check, trust, first = _grounds(options, cell, _tasks(options, targets, cell))
    readings, sigma = settings.readings, settings.sigma
    try:
        papers = paper_protocol(cell)
    except InputError:
        papers = None
    warnings = no_envelope_text(ground.model, ground.draws)
    reference = targets or (ground.expected_sd(papers, readings=1, sigma=sigma) if papers is not None else None)
    planner = Planner(ground, settings, reference, bar.part("plan"))
    settings = planner.settings
    if targets and options.after is not None and trust.usable and planner.should_stop(check):
        return _stop(options, cell, check, trust)
    most = options.n or 69
    if targets:
        # What comes after measured sweeps is measured even if it does not suffice.
        chosen = planner.fewest(most=most, check=check, settle=bool(options.n and options.after))
    elif options.minutes is None:
        chosen = planner.best(most)
    else:
        chosen = planner.within(60.0 * options.minutes, most)
    chosen, others = _named(chosen), {}
    ordered = planner.in_order(chosen.sweeps, options.output)
    seconds = {"plan": duration(cell, ordered, readings, settings.limits)}
    if settings.several:
        plain = planner.in_order(planner.single(len(chosen)).sweeps)
        others["single joints"] = planner.left(plain, check)
        seconds["single joints"] = duration(cell, plain, readings, settings.limits)
    expected = {"before": check.expected_sd(None), "plan": planner.left(ordered, check)}
    expected |= {"plan, where it was made": planner.left(ordered), **others}
    if options.minutes is not None and seconds["plan"] > 60.0 * options.minutes:
        raise InputError(
            f"{len(ordered)} sweeps that reach the targets take {seconds['plan'] / 60.0:.3g} min, expected at most "
            f"{options.minutes:g}"
        )
    if papers is not None:
        for name, often in (("paper", 1), ("paper, midpoints", 2)):
            expected[name] = check.expected_sd(papers, readings=often, sigma=sigma)
            seconds[name] = duration(cell, papers, often, settings.limits)
    if targets and planner.excess(expected["plan"]) > 1.0:
        warnings.append(planner.unreached(expected["plan"], len(ordered)))
    warnings += shortfalls(check, ordered, readings=readings, sigma=sigma)
    if ground.machine is not None:
        warnings += _uncovered(cell, ground, [ordered, *first])
    elif cell.mechanics is not None:
        warnings.append("the estimate knows nothing of the cell's mechanics: the expected sd are of a perfect one")
    if ground.goals.dropped:
        warnings.append(f"{ground.goals.dropped} of {options.draws} draws are left out: a task is out of reach there")
    frontier = None
    if options.frontier is not None:
        frontier = planner.frontier(check, max(len(ordered), _MOST_FRONTIER), bar.part("frontier"))
        points = {name: Point(69, seconds[name], expected[name]) for name in expected if name.startswith("paper")}
    plan_validation.write_planned(options, Ticket(str(options.output), ordered, np.full(len(ordered), readings)), cell)
    if frontier is not None:
        report.save_figure(report.draw_frontier(frontier, points), options.frontier)
    warnings += trust.texts
    told = expected if trust.usable else None
    content = plan_content(chosen, ordered, told, seconds, _record(options, settings), warnings)
    if frontier is not None and trust.usable:
        content["frontier"] = frontier_content(frontier)
    write_result(options.json, "plan", about(cell) | content, trust)
    parts: list[object] = [sweeps_table(cell, ordered, f"{options.output}: {counted(len(ordered), 'sweep')}")]
    if trust.usable:
        shown = {name: sd for name, sd in expected.items() if name != "plan, where it was made"}
        parts.append(accuracy_table(shown, "expected standard deviation at the worst point"))
        if reference is not None:
            made, other = (planner.excess(expected[name]) for name in ("plan, where it was made", "plan"))
            of = "target"
            if not targets:
                # The paper's sweeps are held to the same draws.
                of, other = "paper", max(expected["plan"][task] / sd for task, sd in expected["paper"].items())
            judged = f", {other:.2f} on draws not planned for" if len(ground.goals.values) > 1 else ""
            parts.append(f"worst task: {made:.2f} of the {of} expected{judged}")
    if frontier is not None:
        knee = f"knee of the frontier: {frontier.points[frontier.knee].sweeps} sweeps"
        parts.append(f"{knee}, farthest from the straight line between its ends in logarithms")
    if settings.several and not (np.count_nonzero(chosen.sweeps.q_start != chosen.sweeps.q_end, axis=1) > 1).any():
        parts.append("no joints move together: one at a time leaves less")
    parts.append("time: " + ", ".join(f"{name} {value / 60.0:.1f} min" for name, value in seconds.items()))
    show(options, parts, warnings)
    return 0


def _named(chosen: ChosenSweeps) -> ChosenSweeps:
    """The sweeps named by their usefulness and the joints that move."""
    moves = chosen.sweeps.q_start != chosen.sweeps.q_end
    moved = ("".join(f"q{i}" for i, m in enumerate(row, 1) if m) for row in moves)
    names = [f"p{number:02d}-{joints}" for number, joints in enumerate(moved, 1)]
    return replace(chosen, sweeps=replace(chosen.sweeps, label=np.array(names, dtype=np.str_)))


def _stop(options: argparse.Namespace, cell: Cell, check: Ground, trust: Trust) -> int:
    """Write a plan without sweeps: what is known keeps to the targets."""
    write_plan(options.output, empty_ticket(str(options.output)), cell)
    expected = {task: 1e3 * sd for task, sd in check.expected_sd(None).items()}
    content = {"n_sweeps": 0, "should_stop": True, "expected_sd_nm": {"before": expected}, "warnings": []}
    write_result(options.json, "plan", about(cell) | content, trust)
    show(options, [f"{options.output}: no sweeps, {options.after} already reaches the targets"])
    return 0


def _uncovered(cell: Cell, ground: Ground, sweeps: list[Sweeps]) -> list[str]:
    """A sentence for each joint that the tasks move farther than the sweeps do."""
    low, high = ground.goals.reach
    ends = np.concatenate([part for each in sweeps for part in (each.q_start, each.q_end)])
    beyond = np.maximum(ends.min(axis=0) - low, high - ends.max(axis=0))
    return [
        f"q{i + 1}: the tasks go to {low[i] / scale:.3g} .. {high[i] / scale:.3g} {cell.joints[i].unit}, beyond the "
        "sweeps, which do not tell its error motions there"
        for i, scale in enumerate(cell.joint_scales)
        if beyond[i] > _BEYOND * (high[i] - low[i])
    ]


class _Bar:
    """How far the search is: a bar on a terminal, else a line now and then, from the second second on."""

    def __init__(self, quiet: bool) -> None:
        self._terminal, self._quiet = sys.stderr.isatty(), quiet
        self._next = time.monotonic() + _FIRST_LINE
        self._bar = Progress(console=Console(stderr=True), disable=quiet or not self._terminal, transient=True)

    def __enter__(self) -> "_Bar":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def part(self, name: str) -> Callable[[float], None]:
        """What shows the share done of a part of the work."""
        task, began = self._bar.add_task(name, total=1.0), time.monotonic()

        def tell(share: float) -> None:
            now = time.monotonic()
            self._bar.update(task, completed=share)
            if self._quiet or self._terminal or now < self._next or not share > 0:
                return
            self._next = now + _BETWEEN_LINES
            left = (now - began) * (1.0 - share) / share
            print(f"fpcal: {name}: {100 * share:.0f} % done, about {max(left, 1.0):.0f} s left", file=sys.stderr)

        return tell


def _commission(options: argparse.Namespace, cell: Cell, settings: PlanSettings) -> int:
    warm_up(cell)
    sweeps, (model, draws) = commission_plan(cell), prior_draws(cell)
    require_within_envelope(model, draws, sweeps.q_start, sweeps.q_end, file=options.output)
    planned = Ticket(str(options.output), sweeps, np.full(len(sweeps), settings.readings))
    plan_validation.write_planned(options, planned, cell)
    warnings = no_envelope_text(model, draws)
    seconds = duration(cell, sweeps, settings.readings, settings.limits)
    content = {"n_sweeps": len(sweeps), "seconds": {"plan": seconds}, "warnings": warnings}
    write_result(options.json, "plan", about(cell) | content, Trust())
    table = sweeps_table(cell, sweeps, f"{options.output}: {counted(len(sweeps), 'sweep')}")
    then = "fpcal doctor then says what is connected otherwise than in the cell"
    show(options, [table, f"time: {seconds / 60.0:.1f} min; {then}"], warnings)
    return 0


def _grounds(options: argparse.Namespace, cell: Cell, tasks: list[str]) -> tuple[Ground, Ground, Trust, list[Sweeps]]:
    """What the plan is made on and judged on, what is held against what is known, and the sweeps that come first."""
    sigma, common = options.sigma_nm * 1e-3, {"tasks": tasks, "radius": options.radius_um}
    first: Sweeps | None = None
    if options.after is not None:
        first = read_sweeps(options.after, cell, plan=True).of_session(options.session)
        first = first.take(first.kind != "path")
        if len(first) == 0:
            raise InputError(f"{options.after}: every row is of kind path, expected at least one sweep")
    estimate, before = None, [] if first is None else [first]
    extra = [*before]
    if options.purpose == "extrinsic":
        if options.estimate is None:
            raise InputError("--for extrinsic: expected --estimate ESTIMATE, what is known of the cell")
        estimate = propagated(read_estimate(options.estimate, cell), 24.0 if options.hours is None else options.hours)
    elif options.estimate is not None or options.hours is not None:
        raise InputError("--estimate and --hours: expected beside --for extrinsic only; --after takes measured sweeps")
    warm_up_inverse(cell)
    draws = [(options.draws, options.seed), (min(options.draws, _CHECKED), options.seed + 1_000_003)]
    if estimate is not None:
        grounds = [estimate_ground(estimate, **common)] * 2
    elif first is not None and first.measured:
        estimate, extra = measured_estimate(cell, first), []
        grounds = [measured_ground(estimate, first, draws=n, seed=number, **common) for n, number in draws]
    else:
        grounds = [prior_ground(cell, draws=n, seed=number, **common) for n, number in draws]
    if options.absolute:
        at = np.zeros((1, len(cell.joints)))
        extra.append(Sweeps.of_um_rad(at, at, kind="absolute", sigma=cell.wavelength / 8.0, label="absolute length"))
    for part in extra:
        grounds = [ground.with_known(part, sigma) for ground in grounds]
    return grounds[0], grounds[1], Trust() if estimate is None else estimate.trust, before


def _targets(text: str | None) -> dict[str, float]:
    """Targets by task in um."""
    targets = {}
    for part in [] if text is None else text.split(","):
        found = _TARGET.fullmatch(part.strip())
        if found is None:
            raise InputError(f"--reach {part!r}: expected TASK=NM, as in tilt-x=5nm,circle=1nm")
        try:
            targets[found["task"].strip()] = positive(found["size"]) * 1e-3
        except argparse.ArgumentTypeError as error:
            raise InputError(f"--reach {part!r}: {error}") from error
    return targets


def _tasks(options: argparse.Namespace, targets: dict[str, float], cell: Cell) -> list[str]:
    if options.tasks is None:
        return list(targets or possible_tasks(cell, DEFAULT_TASKS) or possible_tasks(cell))
    return [name.strip() for name in options.tasks.split(",") if name.strip()]


def _settings(options: argparse.Namespace, cell: Cell) -> PlanSettings:
    together = cell.envelope is not None and bool(cell.envelope.together)
    return PlanSettings(
        readings=(2 if options.midpoints else 1) if options.readings is None else options.readings,
        sigma=options.sigma_nm * 1e-3,
        n_candidates=options.candidates,
        several=together if options.coordinated is None else options.coordinated,
        **({} if cell.mechanics is None else {"starts": 3, "crossings": 5, "share": 8}),
        seed=options.seed,
        limits=SweepLimits(tilt=float(np.radians(options.max_tilt_deg)), fringe_rate=options.max_fringe_rate),
    )


def _record(options: argparse.Namespace, settings: PlanSettings) -> dict[str, object]:
    asked = {"for": options.purpose, "reach": options.reach, "sigma_nm": options.sigma_nm, "draws": options.draws}
    used = {name: getattr(settings, name) for name in ("readings", "starts", "crossings", "iterations", "seed")}
    named = {"candidates": settings.n_candidates, "coordinated": settings.several}
    return {**asked, **used, **named, "limits": dict(vars(settings.limits))}
