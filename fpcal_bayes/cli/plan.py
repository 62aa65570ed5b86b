"""``fpcal plan``: fewer sweeps for the same or a better accuracy of the tasks."""

import argparse
import re
from dataclasses import replace
from math import radians

import numpy as np

from fpcal_bayes.cli import plan_validation
from fpcal_bayes.cli.arguments.common import positive
from fpcal_bayes.cli.common import cell_of, check_suffix, console, warn, write_result
from fpcal_bayes.cli.driven import warm_up_inverse
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.design.candidates import SweepLimits
from fpcal_bayes.infer.design.commission import commission_plan
from fpcal_bayes.infer.design.plan import Planner, PlanSettings, duration, in_safe_order, shortfalls
from fpcal_bayes.infer.design.problem import DEFAULT_TASKS, Ground, estimate_ground, measured_estimate, prior_ground
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES, read_sweeps, write_sweeps
from fpcal_bayes.io.tickets import write_plan
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Ticket
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import no_envelope_text, require_within_envelope
from fpcal_bayes.model.margin import prior_draws
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.motion.tasks import possible_tasks
from fpcal_bayes.report.pages import save_figure
from fpcal_bayes.report.plan import accuracy_table, draw_plan, plan_content, sweeps_table
from fpcal_bayes.tracking.drift import propagated

_TARGET = re.compile(r"(?P<task>[^=,]+)=(?P<size>[0-9.eE+-]+)(?:nm)?")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    cell = cell_of(options)
    sizes = (options.n is not None or options.reach is not None, options.commission, options.validation is not None)
    if sum(sizes) != 1:
        raise InputError("expected --n N or --reach TASK=NM,.., or --commission alone, or --validation N alone")
    targets = _targets(options.reach)
    for rows in (options.output, options.rows):
        check_suffix(rows, ".csv", *HDF5_SUFFIXES)
    check_suffix(options.figure, ".svg", ".png")
    settings = _settings(options)
    if options.commission:
        return _commission(options, cell, settings)
    if options.validation is not None:
        return plan_validation.run(options, cell, settings.limits)
    tasks = _tasks(options, targets, cell)
    # A plan is judged on other draws than those it is made for, else the figures flatter it.
    ground, check, trust = _grounds(options, cell, tasks)
    readings, sigma = settings.readings, settings.sigma
    papers = _paper(cell)
    warnings = no_envelope_text(ground.model, ground.draws)
    reference = targets or (ground.expected_sd(papers, readings=1, sigma=sigma) if papers is not None else None)
    planner = Planner(ground, settings, reference)
    settings = planner.settings
    chosen = planner.fewest(most=options.n or 69, check=check) if targets else planner.best(options.n)
    chosen = replace(chosen, sweeps=_labelled(chosen.sweeps))
    ordered = in_safe_order(ground, chosen.sweeps, options.output)

    expected = {"before": check.expected_sd(None), "plan": check.expected_sd(ordered, readings=readings, sigma=sigma)}
    seconds = {"plan": duration(cell, ordered, readings, settings.limits)}
    if papers is not None:
        for name, often in (("paper", 1), ("paper, midpoints", 2)):
            expected[name] = check.expected_sd(papers, readings=often, sigma=sigma)
            seconds[name] = duration(cell, papers, often, settings.limits)
    warnings += shortfalls(check, ordered, readings=readings, sigma=sigma)
    if cell.mechanics is not None:
        warnings.append(
            "the expected sd are those of a perfect mechanism: they compare plans and promise nothing of a machine; "
            f"fpcal observe {options.output} takes the stated error motions into account"
        )
    if ground.goals.dropped:
        warnings.append(f"{ground.goals.dropped} of {options.draws} draws are left out: a task is out of reach there")

    planned = Ticket(str(options.output), ordered, np.full(len(ordered), readings))
    write_plan(options.output, planned, cell)
    if options.rows is not None:
        write_sweeps(options.rows, planned.rows(), cell)
    if options.figure is not None:
        save_figure(draw_plan(cell, ordered), options.figure)
    warnings += [reason.text for reason in trust.reasons]
    content = plan_content(
        chosen, ordered, expected if trust.usable else None, seconds, _record(options, settings), warnings
    )
    write_result(options.json, "plan", {"cell": {"name": cell.name, "sha256": cell.sha256}, **content}, trust)
    out = console(options)
    out.print(sweeps_table(cell, ordered, f"{options.output}: {len(ordered)} sweeps"))
    if trust.usable:
        out.print(accuracy_table(expected, "expected standard deviation at the worst point"))
    times = ", ".join(f"{name} {value / 60.0:.1f} min" for name, value in seconds.items())
    out.say(f"time: {times}")
    warn(warnings)
    return 0


def _commission(options: argparse.Namespace, cell: Cell, settings: PlanSettings) -> int:
    """Write the sweeps that a new cell is commissioned with."""
    warm_up(cell)
    sweeps, (model, draws) = commission_plan(cell), prior_draws(cell)
    require_within_envelope(model, draws, sweeps.q_start, sweeps.q_end, file=options.output)
    planned = Ticket(str(options.output), sweeps, np.full(len(sweeps), settings.readings))
    write_plan(options.output, planned, cell)
    if options.rows is not None:
        write_sweeps(options.rows, planned.rows(), cell)
    if options.figure is not None:
        save_figure(draw_plan(cell, sweeps), options.figure)
    warnings = no_envelope_text(model, draws)
    seconds = duration(cell, sweeps, settings.readings, settings.limits)
    content = {"n_sweeps": len(sweeps), "seconds": {"plan": seconds}, "warnings": warnings}
    write_result(options.json, "plan", {"cell": {"name": cell.name, "sha256": cell.sha256}, **content}, Trust())
    out = console(options)
    out.print(sweeps_table(cell, sweeps, f"{options.output}: {len(sweeps)} sweeps"))
    out.say(f"time: {seconds / 60.0:.1f} min; fpcal doctor then says what is connected otherwise than in the cell")
    warn(warnings)
    return 0


def _grounds(options: argparse.Namespace, cell: Cell, tasks: list[str]) -> tuple[Ground, Ground, Trust]:
    """What the plan is made on, what it is judged on, and what is held against what is known."""
    sigma, common = options.sigma_nm * 1e-3, {"tasks": tasks, "radius": options.radius_um}
    first: Sweeps | None = None
    if options.after is not None:
        first = read_sweeps(options.after, cell, plan=True).of_session(options.session)
        first = first.take(first.kind != "path")
        if len(first) == 0:
            raise InputError(f"{options.after}: every row is of kind path, expected at least one sweep")
    estimate = None
    if options.purpose == "extrinsic":
        if options.estimate is None:
            raise InputError("--for extrinsic: expected --estimate ESTIMATE, what is known of the cell")
        estimate = propagated(read_estimate(options.estimate, cell), 24.0 if options.hours is None else options.hours)
    elif options.estimate is not None or options.hours is not None:
        raise InputError("--estimate and --hours: expected beside --for extrinsic only; --after takes measured sweeps")
    warm_up_inverse(cell)
    if estimate is None and first is not None and first.measured:
        estimate, first = measured_estimate(cell, first), None
    if estimate is not None:
        grounds = [estimate_ground(estimate, **common)] * 2
    else:
        grounds = [prior_ground(cell, draws=options.draws, seed=options.seed + i, **common) for i in (0, 1_000_003)]
    extra = [] if first is None else [first]
    if options.absolute:
        extra.append(_absolute(cell))
    for part in extra:
        grounds = [ground.with_known(part, sigma) for ground in grounds]
    return grounds[0], grounds[1], Trust() if estimate is None else estimate.trust


def _absolute(cell: Cell) -> Sweeps:
    """One absolute length at joint vector zero."""
    home = np.zeros((1, len(cell.joints)))
    return Sweeps.of_um_rad(home, home, kind="absolute", sigma=cell.wavelength / 8.0, label="absolute length")


def _labelled(sweeps: Sweeps) -> Sweeps:
    """Sweeps named by their usefulness and the joints that move."""
    moved = sweeps.q_start != sweeps.q_end
    names = [
        f"p{number:02d}-" + "".join(f"q{i}" for i, m in enumerate(row, 1) if m) for number, row in enumerate(moved, 1)
    ]
    return replace(sweeps, label=np.array(names, dtype=np.str_))


def _paper(cell: Cell) -> Sweeps | None:
    """The paper's sweeps, if the cell can make them."""
    try:
        return paper_protocol(cell)
    except InputError:
        return None


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
    tasks = [name.strip() for name in options.tasks.split(",") if name.strip()]
    if not tasks:
        raise InputError("--tasks: expected one task at least")
    return list(dict.fromkeys(tasks))


def _settings(options: argparse.Namespace) -> PlanSettings:
    readings = options.readings or (2 if options.midpoints else 1)
    return PlanSettings(
        readings=readings,
        sigma=options.sigma_nm * 1e-3,
        criterion=options.criterion,
        n_candidates=options.candidates,
        variations=options.variations,
        several=not options.single_joints,
        seed=options.seed,
        limits=_limits(options),
    )


def _limits(options: argparse.Namespace) -> SweepLimits:
    given = {
        "tilt": None if options.max_tilt_deg is None else radians(options.max_tilt_deg),
        "fringe_rate": options.max_fringe_rate,
    }
    return SweepLimits(**{name: value for name, value in given.items() if value is not None})


def _record(options: argparse.Namespace, settings: PlanSettings) -> dict[str, object]:
    """How the plan was searched, for JSON."""
    return {
        "for": options.purpose,
        "reach": options.reach,
        "readings": settings.readings,
        "sigma_nm": options.sigma_nm,
        "criterion": settings.criterion,
        "candidates": settings.n_candidates,
        "variations": settings.variations,
        "iterations": settings.iterations,
        "draws": options.draws,
        "seed": settings.seed,
        "limits": dict(vars(settings.limits)),
    }
