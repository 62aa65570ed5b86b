"""``fpcal plan``: fewer sweeps for the same or a better accuracy of the tasks."""

import argparse
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fpcal_bayes.cli.control import warm_up_inverse
from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    count,
    positive,
    seed,
    warn,
    write_result,
)
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.model.cell.cell import Cell

if TYPE_CHECKING:
    from fpcal_bayes.infer.design.candidates import SweepLimits
    from fpcal_bayes.infer.design.plan import PlanSettings
    from fpcal_bayes.infer.design.problem import Ground
    from fpcal_bayes.measure.sweeps import Sweeps


_EPILOG = """\
Sweeps are chosen among random candidates, one joint or several joints of one controller moving, such that the worst
task, in units of what the paper's 69 sweeps leave, is expected to be known best; then they are varied to serve better,
and at the end all of them move together to where the criterion is smallest nearby.
Without an estimate the plan is averaged over draws of the prior, so that it is good before the cell is known.

--reach tilt-x=5nm,circle=1nm asks for the fewest sweeps that are expected to reach these standard deviations at each
task's worst point. --for extrinsic plans a re-identification: --estimate says what is known, --hours how long ago.
--after FILE are sweeps that come first: measured ones are identified, and the plan holds the best next sweeps.

SWEEPS holds whole sweeps. --rows writes the readings of each as rows of one group, for `fpcal simulate --protocol`.
Criteria: worst (task), I (mean over tasks), A, D, E (of the parameters), O1 (observability index).
"""

_TARGET = re.compile(r"(?P<task>[^=,]+)=(?P<size>[0-9.eE+-]+)(?:nm)?")


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "plan", "choose which sweeps to measure", run, _EPILOG)
    parser.add_argument(
        "-o", dest="output", metavar="SWEEPS", type=Path, required=True, help="plan to write: .csv or .h5"
    )
    parser.add_argument("--n", type=count, metavar="N", help="number of sweeps (with --reach: at most)")
    parser.add_argument("--reach", metavar="TASK=NM,..", help="fewest sweeps that reach these standard deviations")
    parser.add_argument("--tasks", metavar="TASK,..", help="tasks that count (default: circle,tilt-x,tilt-z,spin)")
    parser.add_argument("--radius-um", type=positive, default=100.0, metavar="R", help="of the circle (default: 100)")
    parser.add_argument(
        "--for", dest="purpose", choices=("full", "extrinsic"), default="full", help="calibration or re-identification"
    )
    parser.add_argument("--estimate", metavar="ESTIMATE", help="with --for extrinsic: what is known")
    parser.add_argument("--hours", type=positive, metavar="H", help="with --for extrinsic: drift since (default: 24)")
    parser.add_argument("--after", metavar="FILE", help="sweeps, measured or planned, that come first")
    parser.add_argument("--session", metavar="NAME", help="session of these (default: the first)")
    parser.add_argument(
        "--midpoints", action=argparse.BooleanOptionalAction, default=True, help="read each sweep at its middle too"
    )
    parser.add_argument(
        "--readings", type=count, metavar="K", help="readings of a sweep after its start, evenly spaced"
    )
    parser.add_argument("--absolute", action="store_true", help="suppose one absolute length, known to lambda/8")
    parser.add_argument("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    parser.add_argument(
        "--criterion", choices=("worst", "I", "A", "D", "E", "O1"), default="worst", help="see below (default: worst)"
    )
    parser.add_argument("--candidates", type=count, default=2000, metavar="N", help="to choose from (default: 2000)")
    parser.add_argument("--draws", type=count, default=64, metavar="N", help="of the prior (default: 64)")
    parser.add_argument("--max-tilt-deg", type=positive, metavar="A", help="of mirror against light (default: 4.3)")
    parser.add_argument("--max-fringe-rate", type=positive, metavar="HZ", help="that is counted (default: 1000)")
    parser.add_argument("--single-joints", action="store_true", help="move one joint at a time only")
    parser.add_argument(
        "--reversals", type=positive, metavar="F", help="variance factor where dL reverses (default: 1)"
    )
    parser.add_argument(
        "--variations", type=count, default=30, metavar="N", help="of each sweep in a round of refinement (default: 30)"
    )
    parser.add_argument(
        "--iterations", type=seed, default=100, metavar="N", help="of the descent at the end (default: 100)"
    )
    parser.add_argument("--seed", type=seed, default=0, help="of the search (default: 0)")
    parser.add_argument("--rows", metavar="OUT", type=Path, help="write the readings as rows: .csv or .h5")
    parser.add_argument("--figure", metavar="OUT", type=Path, help="draw the plan: .svg or .png")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.infer.design.plan import Planner, duration, in_short_order, shortfalls
    from fpcal_bayes.infer.design.rows import read_often
    from fpcal_bayes.io.sweeps import write_sweeps
    from fpcal_bayes.report.plan import accuracy_table, plan_content, sweeps_table

    cell = cell_of(options)
    if options.n is None and options.reach is None:
        raise InputError("expected --n N or --reach TASK=NM,..")
    targets = _targets(options.reach)
    outputs = [options.output, options.rows, options.json, options.figure]
    for i, output in enumerate(outputs):
        check_output(output, options.after, options.estimate, *outputs[:i])
    _check_suffixes(options)
    settings = _settings(options)
    tasks = _tasks(options, targets, cell)
    # A plan is judged on other draws than those it is made for, else the figures flatter it.
    ground, check = _grounds(options, cell, tasks)
    readings, sigma = settings.readings, settings.sigma
    papers = _paper(cell)
    warnings = []
    reference = targets or (ground.expected_sd(papers, readings=1, sigma=sigma) if papers is not None else None)
    planner = Planner(ground, settings, reference)
    chosen = planner.fewest(most=options.n or 69, check=check) if targets else planner.best(options.n)
    chosen = replace(chosen, sweeps=_labelled(chosen.sweeps))
    ordered = in_short_order(cell, chosen.sweeps, settings.limits)

    expected = {"before": check.expected_sd(None), "plan": check.expected_sd(ordered, readings=readings, sigma=sigma)}
    seconds = {"plan": duration(cell, ordered, readings, settings.limits)}
    if papers is not None:
        for name, often in (("paper", 1), ("paper, midpoints", 2)):
            expected[name] = check.expected_sd(papers, readings=often, sigma=sigma)
            seconds[name] = duration(cell, papers, often, settings.limits)
    warnings += shortfalls(check, ordered, readings=readings, sigma=sigma)
    if ground.goals.dropped:
        warnings.append(f"{ground.goals.dropped} of {options.draws} draws are left out: a task is out of reach there")

    write_sweeps(options.output, ordered, cell)
    if options.rows is not None:
        write_sweeps(options.rows, read_often(ordered, readings), cell)
    if options.figure is not None:
        from fpcal_bayes.report.plan import draw_plan
        from fpcal_bayes.report.week import save_figure

        save_figure(draw_plan(cell, ordered), options.figure)
    out = console(options)
    out.print(sweeps_table(cell, ordered, f"{options.output}: {len(ordered)} sweeps"))
    out.print(accuracy_table(expected, "expected standard deviation at the worst point"))
    times = ", ".join(f"{name} {value / 60.0:.1f} min" for name, value in seconds.items())
    out.print(f"time: {times}", soft_wrap=True, markup=False)
    warn(warnings)
    content = plan_content(chosen, ordered, expected, seconds, _record(options, settings), warnings)
    write_result(options.json, "plan", {"cell": {"name": cell.name, "sha256": cell.sha256}, **content})
    return 0


def _grounds(options: argparse.Namespace, cell: Cell, tasks: list[str]) -> "tuple[Ground, Ground]":
    """What the plan is made on, and what it is judged on."""
    from fpcal_bayes.infer.design.problem import estimate_ground, measured_estimate, prior_ground
    from fpcal_bayes.io.estimate import read_estimate
    from fpcal_bayes.io.sweeps import read_sweeps
    from fpcal_bayes.tracking.drift import aged

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
        estimate = aged(read_estimate(options.estimate, cell), 24.0 if options.hours is None else options.hours)
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
    return grounds[0], grounds[1]


def _absolute(cell: Cell) -> "Sweeps":
    """One absolute length at joint vector zero."""
    import numpy as np

    from fpcal_bayes.measure.sweeps import Sweeps

    home = np.zeros((1, len(cell.joints)))
    return Sweeps.make(home, home, kind="absolute", sigma=cell.wavelength / 8.0, label="absolute length")


def _labelled(sweeps: "Sweeps") -> "Sweeps":
    """Sweeps named by their usefulness and the joints that move."""
    import numpy as np

    moved = sweeps.q_start != sweeps.q_end
    names = [
        f"p{number:02d}-" + "".join(f"q{i}" for i, m in enumerate(row, 1) if m) for number, row in enumerate(moved, 1)
    ]
    return replace(sweeps, label=np.array(names, dtype=np.str_))


def _paper(cell: Cell) -> "Sweeps | None":
    """The paper's sweeps, if the cell can make them."""
    from fpcal_bayes.measure.protocol import paper_protocol

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
    from fpcal_bayes.infer.design.problem import DEFAULT_TASKS
    from fpcal_bayes.motion.tasks import possible_tasks

    if options.tasks is None:
        return list(targets) if targets else list(possible_tasks(cell, DEFAULT_TASKS))
    tasks = [name.strip() for name in options.tasks.split(",") if name.strip()]
    if not tasks:
        raise InputError("--tasks: expected one task at least")
    return list(dict.fromkeys(tasks))


def _settings(options: argparse.Namespace) -> "PlanSettings":
    from fpcal_bayes.infer.design.plan import PlanSettings

    readings = options.readings or (2 if options.midpoints else 1)
    return PlanSettings(
        readings=readings,
        sigma=options.sigma_nm * 1e-3,
        criterion=options.criterion,
        n_candidates=options.candidates,
        variations=options.variations,
        iterations=options.iterations,
        several=not options.single_joints,
        seed=options.seed,
        limits=_limits(options),
    )


def _limits(options: argparse.Namespace) -> "SweepLimits":
    from math import radians

    from fpcal_bayes.infer.design.candidates import SweepLimits

    given = {
        "tilt": None if options.max_tilt_deg is None else radians(options.max_tilt_deg),
        "fringe_rate": options.max_fringe_rate,
        "reversal_variance": options.reversals,
    }
    return SweepLimits(**{name: value for name, value in given.items() if value is not None})


def _record(options: argparse.Namespace, settings: "PlanSettings") -> dict[str, object]:
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


def _check_suffixes(options: argparse.Namespace) -> None:
    """Refuse names of files that cannot be written, before any work is done."""
    from fpcal_bayes.io.sweeps import HDF5_SUFFIXES

    for path in (options.output, options.rows):
        if path is not None and path.suffix.lower() not in (".csv", *HDF5_SUFFIXES):
            raise InputError(f"{path}: expected a file name that ends in .csv, {' or '.join(HDF5_SUFFIXES)}")
    if options.figure is not None and options.figure.suffix.lower() not in (".svg", ".png"):
        raise InputError(f"{options.figure}: expected a file name that ends in .svg or .png")
