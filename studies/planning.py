"""Accuracy against the number of sweeps: the paper's order, random, greedy, best found, adaptive.

    python studies/planning.py accuracy --numbers 10,12,14 --simulate    each way; simulated, too
    python studies/planning.py extrinsic                                 the best 1 to 6 sweeps a day after
    python studies/planning.py machine --numbers 20 --truths 40          error motions: simulated, fitted, compensated
    python studies/planning.py figure A.json .. --figure OUT.svg         of what accuracy --json wrote

Figures are relative to what the paper's 69 sweeps leave. Expected ones are judged at draws of the prior that no plan is
made for, simulated ones by the largest error along each task after identifying simulated measurements of these truths.
Each ratio is given twice: of root mean squares over the truths, and as the mean over truths of the ratio.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mechanics_coverage import reachable

from fpcal_bayes import InputError
from fpcal_bayes.core import write_json
from fpcal_bayes.infer import (
    DEFAULT_TASKS,
    PATH_POINTS,
    Ground,
    Planner,
    PlanSettings,
    SweepLimits,
    candidate_sweeps,
    estimate_ground,
    identify,
    in_short_order,
    measured_ground,
    predict_from_covariance,
    prior_ground,
    task_errors,
)
from fpcal_bayes.io import load_cell, write_sweeps
from fpcal_bayes.measure import Sweeps, Truth, drive_of_sweeps, join, paper_protocol, paper_truth, read_often
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.motion import task_path
from fpcal_bayes.report import draw_plan, save_figure
from fpcal_bayes.simulator import Machine, MachineSettings, simulate_um
from fpcal_bayes.tracking import propagated

SIGMA = 0.005
#: Standard deviations or errors by task in um, one a truth.
ByTask = dict[str, np.ndarray]
#: Expected standard deviation by task in um: what comparisons leave by name, plans by way and number of sweeps.
Levels = dict[str, dict[str, float]]
Found = dict[str, dict[int, dict[str, float]]]
#: Points of each path.
_POINTS = 31
#: Errors drawn by linear theory at each truth; share of them that is kept; how rare those are that stand out.
_DRAWN, _KEPT, _RARE = 1000, 0.95, 0.002
#: Standard deviations beyond which an error is none that its estimate tells.
_UNTOLD = 3.0
#: Sets of truths drawn from those simulated, to tell how far chance alone moves a ratio.
_SETS = 1000


def largest_errors(cell: Cell, values: np.ndarray, plan: Sweeps, *, sigma: float, seed: int) -> dict[str, float]:
    """Largest error along each task, in um, after identifying a simulated cell from simulated measurements.

    `values` (n_free,) are the truth's free parameters in um and rad; `sigma` is the standard deviation of each change
    of cavity length in um. NaN where the estimate leaves no point to drive to.
    """
    model = CavityModel.of(cell)
    truth = Truth(cell.free, np.zeros(1), values[None])
    found = identify(cell, simulate_um(cell, truth, plan, sigma=sigma, seed=seed)).estimate
    result = dict.fromkeys(DEFAULT_TASKS, np.nan)
    for name in DEFAULT_TASKS:
        try:
            task = task_path(cell, found.vector(), name, n_points=_POINTS)
        except InputError:
            # By its estimate, this robot's joint limits do not let it take the aligned pose.
            continue
        if task.ok.any():
            result[name] = float(np.abs(task_errors(model, values, found.values, task.take(task.ok))).max())
    return result


def compare(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """One kind of error or standard deviation, above zero, over another at the same truths, shape (n_truths,) each.

    The ratio of the root mean squares and of the medians, and the mean over truths of the ratio, each with its standard
    error (``.._se``) by drawing the truths anew (bootstrap, Efron 1979). The mean ratio of simulated errors leans
    upwards: some truth's error is small by luck.
    """
    picked = np.random.default_rng(0).integers(len(ours), size=(_SETS, len(ours)))

    def ratios(a: np.ndarray, b: np.ndarray) -> dict[str, np.ndarray]:
        return {
            "ratio_of_rms": np.sqrt((a**2).mean(axis=-1) / (b**2).mean(axis=-1)),
            "mean_ratio": (a / b).mean(axis=-1),
            "ratio_of_medians": np.median(a, axis=-1) / np.median(b, axis=-1),
        }

    spread = {name: float(values.std()) for name, values in ratios(ours[picked], theirs[picked]).items()}
    found: dict[str, float] = {}
    for name, value in ratios(ours, theirs).items():
        found |= {name: float(value), f"{name}_se": spread[name]}
    return found


@dataclass(frozen=True)
class Grounds:
    """What plans are made on and judged on, and what the paper's sweeps leave there."""

    made: Ground
    judged: Ground
    reference: dict[str, float]
    paper: ByTask

    @classmethod
    def of(cls, cell: Cell, options: argparse.Namespace) -> "Grounds":
        tasks = tuple(options.tasks)
        made = prior_ground(cell, tasks=tasks, draws=options.draws, seed=options.seed)
        judged = prior_ground(cell, tasks=tasks, draws=options.truths, points=31, seed=options.seed + 1_000_003)
        paper, often = paper_protocol(cell), 2 if options.against == "midpoints" else 1
        reference = made.expected_sd(paper, readings=often)
        return cls(made, judged, reference, judged.sd_at_draws(paper, readings=often))


def show(name: str, ours: ByTask, theirs: ByTask) -> None:
    """Two lines: ratio of root mean squares, and mean ratio, with standard errors over the truths."""
    found = {task: compare(ours[task], theirs[task]) for task in theirs}
    for kind, label in (("ratio_of_rms", "rms"), ("mean_ratio", "mean of ratios")):
        parts = [f"{task} {ratio[kind]:6.2f} +- {ratio[kind + '_se']:4.2f}" for task, ratio in found.items()]
        print(f"{name if kind == 'ratio_of_rms' else '':34} {label:14} " + "  ".join(parts), flush=True)


def simulated(cell: Cell, grounds: Grounds, plan: Sweeps, noises: int) -> ByTask:
    """Largest error along each task, root mean square over some noises of each truth.

    NaN where the estimate leaves no point of a task to drive to.
    """
    squares: dict[str, list[float]] = {task: [] for task in grounds.paper}
    for number, values in enumerate(grounds.judged.goals.values):
        found = [largest_errors(cell, values, plan, sigma=SIGMA, seed=number + 1000 * k) for k in range(noises)]
        for task, each in squares.items():
            each.append(float(np.mean([errors[task] ** 2 for errors in found])))
    return {task: np.sqrt(each) for task, each in squares.items()}


def show_simulated(name: str, ours: ByTask, theirs: ByTask) -> None:
    """As `show`, of the truths at which each task can be driven to after either calibration."""
    good = np.isfinite([ours[task] + theirs[task] for task in theirs]).all(axis=0)
    a, b = ({task: errors[good] for task, errors in side.items()} for side in (ours, theirs))
    show(f"{name}, {good.sum()} truths", a, b)


def expected_largest(ground: Ground, plan: Sweeps, readings: int) -> ByTask:
    """Largest error along each task by linear theory: draws of it at each truth, shape (n_truths, n_draws), in um."""
    design = ground.driven(plan, readings=readings, sigma=SIGMA)
    z = np.random.default_rng(0).standard_normal((design.n_parameters, _DRAWN))
    found: dict[str, list[np.ndarray]] = {name: [] for name in design.names}
    for jacobian, root in zip(design.tasks, design.roots(()), strict=True):
        errors = np.abs(jacobian @ root @ z)
        for task, name in enumerate(design.names):
            found[name].append(errors[design.task_of_point == task].max(axis=0))
    return {name: np.array(each) for name, each in found.items()}


def show_beside_theory(name: str, ours: ByTask, theory: ByTask, good: np.ndarray) -> None:
    """Simulated errors over those of linear theory at the same truths, those of `good`, task by task.

    The ratio of root mean squares with its standard error by drawing the truths anew, of these without the largest
    twentieth on either side, and of medians; and the truths whose error exceeds nearly all that theory draws there.
    """
    for task in theory:
        errors, drawn = ours[task][good], theory[task][good]
        picked = np.random.default_rng(0).integers(len(errors), size=(_SETS, len(errors)))
        squares, expected = errors**2, (drawn**2).mean(axis=1)
        spread = np.sqrt(squares[picked].mean(axis=1) / expected[picked].mean(axis=1)).std()
        some, all_some = (np.sort(each.ravel())[: round(_KEPT * each.size)] for each in (errors, drawn))
        trimmed, median = np.sqrt((some**2).mean() / (all_some**2).mean()), np.median(errors) / np.median(drawn)
        ratio = np.sqrt(squares.mean() / expected.mean())
        far = np.flatnonzero((drawn >= errors[:, None]).mean(axis=1) < _RARE)
        named = ", ".join(
            f"{np.flatnonzero(good)[i]} ({1e3 * errors[i]:.3g} for {1e3 * np.sqrt(expected[i]):.3g} nm)" for i in far
        )
        print(
            f"{name}, {good.sum()} truths, {task}: rms {ratio:.2f} +- {spread:.2f}, trimmed {trimmed:.2f}, median "
            f"{median:.2f} of linear theory; beyond it: {named or 'none'}",
            flush=True,
        )


def ways_of(cell: Cell, grounds: Grounds, options: argparse.Namespace) -> dict[str, Callable[[int], Sweeps]]:
    """How n sweeps are chosen, by name."""
    limits, paper = limits_of(options), paper_protocol(cell)
    settings = settings_of(options)

    def planned(**changes: int) -> Callable[[int], Sweeps]:
        planner = Planner(grounds.made, replace(settings, **changes), grounds.reference)
        return lambda n: planner.in_order(planner.best(n).sweeps)

    ways = {
        "paper's order": lambda: lambda n: paper.take(np.arange(n)),
        "random": lambda: lambda n: candidate_sweeps(cell, n=n, rng=np.random.default_rng(options.seed), limits=limits),
        "greedy": lambda: planned(starts=1, iterations=0),
        "best": lambda: planned(),
    }
    return {name: make() for name, make in ways.items() if name in options.ways}


def limits_of(options: argparse.Namespace) -> SweepLimits:
    return SweepLimits(tilt=float(np.radians(options.tilt)))


def settings_of(options: argparse.Namespace) -> PlanSettings:
    return PlanSettings(
        seed=options.seed,
        limits=limits_of(options),
        readings=options.readings,
        share=options.share,
        several=options.coordinated,
    )


def accuracy(options: argparse.Namespace) -> None:
    """Each way at each number of sweeps."""
    cell = load_cell(mechanics=options.mechanics)
    grounds, paper = Grounds.of(cell, options), paper_protocol(cell)
    levels: Levels = {}
    for often, name in ((1, "paper, 69 end points"), (2, "paper, 69 with midpoints")):
        levels[name] = grounds.judged.expected_sd(paper, readings=often)
        print(f"{name}: " + ", ".join(f"{task} {1e3 * sd:.2f} nm" for task, sd in levels[name].items()), flush=True)
    often = 2 if options.against == "midpoints" else 1
    theirs = simulated(cell, grounds, read_often(paper, often), options.noises) if options.simulate else {}
    found: Found = {}
    for name, choose in ways_of(cell, grounds, options).items():
        for n in options.numbers:
            began = time.process_time()
            plan = choose(n)
            spent = time.process_time() - began
            if name in ("random", "greedy"):
                plan = in_short_order(cell, plan)
            each = grounds.judged.sd_at_draws(plan, readings=options.readings)
            show(f"{n} {name} ({spent:.0f} s)", each, grounds.paper)
            found.setdefault(name, {})[n] = {task: float(np.sqrt((sd**2).mean())) for task, sd in each.items()}
            record(options, levels, found)
            if options.plans is not None and name == "best":
                options.plans.mkdir(parents=True, exist_ok=True)
                write_sweeps(options.plans / f"plan-{n}.csv", plan, cell)
                save_figure(draw_plan(cell, plan), options.plans / f"plan-{n}.png")
            if options.simulate and name == "best":
                ours = simulated(cell, grounds, read_often(plan, options.readings), options.noises)
                show_simulated(f"{n} {name}, simulated", ours, theirs)
                good = np.isfinite([ours[task] + theirs[task] for task in theirs]).all(axis=0)
                sides = {"paper": (theirs, paper, often), f"{n} {name}": (ours, plan, options.readings)}
                for side, (errors, sweeps, readings) in sides.items():
                    show_beside_theory(side, errors, expected_largest(grounds.judged, sweeps, readings), good)
    if options.adaptive:
        for n in options.numbers:
            sd, reference = adaptive(cell, grounds, n, options)
            scale = {task: np.sqrt((sd[task] ** 2).mean() / (reference[task] ** 2).mean()) for task in sd}
            # Few truths: their ratio to the paper's sweeps is carried over to all of them.
            level = levels["paper, 69 with midpoints" if options.against == "midpoints" else "paper, 69 end points"]
            found.setdefault("adaptive", {})[n] = {task: float(scale[task]) * level[task] for task in sd}
            record(options, levels, found)


def record(options: argparse.Namespace, levels: Levels, found: Found) -> None:
    """What is found so far, for a figure: a long run may be ended early."""
    if options.json is not None:
        write_json(options.json, {"levels": levels, "found": found})


def figure(options: argparse.Namespace) -> None:
    """One figure of what several runs found."""
    levels: Levels = {}
    found: Found = {}
    for path in options.files:
        content = json.loads(path.read_text())
        levels |= content["levels"]
        for way, of_way in content["found"].items():
            found.setdefault(way, {}).update({int(n): sd for n, sd in of_way.items()})
    save_figure(draw_accuracy(found, levels), options.figure)


#: Colours of Okabe and Ito, and a marker each.
LINES = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "v"), ("#E69F00", "D"))


def draw_accuracy(found: Found, levels: Levels) -> Figure:
    """Accuracy of each task against the number of sweeps, a panel per task and a line per way of choosing them.

    `levels` are drawn across for comparison.
    """
    tasks = list(next(iter(levels.values())))
    figure = Figure(figsize=(2.9 * len(tasks), 3.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(tasks)))
    for axis, task in zip(axes, tasks, strict=True):
        for style, (name, sd) in zip(("--", ":"), levels.items(), strict=False):
            axis.axhline(1e3 * sd[task], color="0.35", linestyle=style, linewidth=1.2, label=name)
        for (colour, marker), (name, of_way) in zip(LINES, found.items(), strict=False):
            numbers = sorted(of_way)
            sizes = [1e3 * of_way[n][task] for n in numbers]
            axis.plot(numbers, sizes, color=colour, marker=marker, markersize=4, linewidth=1.3, label=name)
        axis.set_xticks(sorted({n for of_way in found.values() for n in of_way}))
        axis.set_yscale("log")
        axis.set_title(task)
        axis.set_xlabel("sweeps")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("expected standard deviation [nm]")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def adaptive(cell: Cell, grounds: Grounds, n: int, options: argparse.Namespace) -> tuple[ByTask, ByTask]:
    """Half of the sweeps are planned before the cell is known, the others on what the first half told."""
    settings = settings_of(options)
    at_once = Planner(grounds.made, settings, grounds.reference).best(n).sweeps
    first, rest = at_once.take(np.arange(n // 2)), at_once.take(np.arange(n // 2, n))
    count = min(options.adaptive, len(grounds.judged.goals.values))
    theirs = {task: sd[:count] for task, sd in grounds.paper.items()}
    same = grounds.judged.at_draws(np.arange(count))
    show(f"{n} at once, {count} truths", same.sd_at_draws(at_once, readings=options.readings), theirs)
    ours: dict[str, list[float]] = {task: [] for task in grounds.paper}
    for number, values in enumerate(same.goals.values):
        truth = Truth(cell.free, np.zeros(1), values[None])
        measured = simulate_um(cell, truth, read_often(first, options.readings), sigma=SIGMA, seed=number)
        second = rest
        try:
            now = measured_ground(identify(cell, measured).estimate, measured, tasks=tuple(grounds.paper), draws=64)
            planner = Planner(now, replace(settings, seed=number, starts=2, crossings=3), grounds.reference)
            found = planner.best(n - n // 2).sweeps
            if planner.judge(found).value(range(len(found))) < planner.judge(rest).value(range(len(rest))):
                second = found
        except InputError as error:
            print(f"truth {number + 1}: {error}; planned at once", flush=True)
        # Judged at the truth, under the cell's own prior.
        there = grounds.judged.at_draws(np.array([number]))
        for task, sd in there.expected_sd(join([first, second]), readings=options.readings).items():
            ours[task].append(sd)
        if (number + 1) % 10 == 0:
            so_far = {task: np.array(sd) for task, sd in ours.items()}
            show(f"{n} adaptive, {number + 1} truths", so_far, {t: sd[: number + 1] for t, sd in theirs.items()})
    return {task: np.array(sd) for task, sd in ours.items()}, theirs


def extrinsic(options: argparse.Namespace) -> None:
    """Best few sweeps some hours after a calibration at the paper's truth."""
    cell = load_cell(mechanics=options.mechanics)
    calibration = simulate_um(
        cell, paper_truth(cell), paper_protocol(cell, midpoints=True), sigma=SIGMA, seed=options.seed
    )
    ground = estimate_ground(
        propagated(identify(cell, calibration).estimate, options.hours), tasks=tuple(options.tasks)
    )
    paper = ground.expected_sd(paper_protocol(cell), readings=1)
    middle = ground.expected_sd(paper_protocol(cell), readings=2)
    for name, sd in (("before", ground.expected_sd(None)), ("paper's 69", paper), ("with midpoints", middle)):
        print(f"{name:34}" + "  ".join(f"{task} {1e3 * value:6.2f} nm" for task, value in sd.items()))
    for n in range(1, 7):
        sd = Planner(ground, settings_of(options), paper).best(n).sd
        print(f"{n:<34}" + "  ".join(f"{task} {1e3 * value[-1]:6.2f} nm" for task, value in sd.items()), flush=True)


def machine(options: argparse.Namespace) -> None:
    """Simulated machines of the cell's sizes, calibrated with plans and with the paper's sweeps with midpoints.

    The error left is that along each task less what the estimate knows of it, at the points that can be driven to: root
    mean square over the truths of the worst point, and what linear theory expects. What an estimate leaves unknown its
    own sd says: truths are counted at which an error is beyond a multiple of the largest sd along its path.
    """
    cell, model = load_cell(), CavityModel.of(load_cell())
    assert cell.mechanics is not None
    ground = prior_ground(cell, tasks=tuple(options.tasks), draws=options.draws, seed=options.seed)
    paper = paper_protocol(cell)
    reference = ground.expected_sd(paper, readings=2)
    planner = Planner(ground, replace(settings_of(options), starts=3, crossings=5, share=8), reference)
    plans = {"paper, midpoints": paper}
    plans |= {str(n): planner.in_order(planner.best(n).sweeps) for n in options.numbers}
    for name, plan in plans.items():
        expected = ground.expected_sd(plan, readings=2)
        print(f"{name:20} expected " + "  ".join(f"{t} {1e3 * sd:6.2f} nm" for t, sd in expected.items()), flush=True)
    left: dict[str, dict[str, list[float]]] = {name: {task: [] for task in options.tasks} for name in plans}
    doubtful, untold = dict.fromkeys(plans, 0), dict.fromkeys(plans, 0)
    for number in range(options.truths):
        vector = reachable(cell, np.random.default_rng([options.seed, number]))
        noise = MachineSettings(student=3.0, slow_nm=4.0)
        drawn = Machine.draw(cell, cell.mechanics, vector, np.random.default_rng([number, 1]), noise)
        for name, plan in plans.items():
            rows = read_often(plan, 2)
            drive = drive_of_sweeps(rows, cell.mechanics.minutes_per_sweep)
            estimate = identify(cell, rows.with_measurement(drawn.sweep(drive, SIGMA), SIGMA)).estimate
            doubtful[name] += not estimate.trust.usable
            beyond = False
            for task_name in options.tasks:
                try:
                    # Beyond a joint's limit, where no controller drives, error motions have no size.
                    task = task_path(cell, estimate.vector(), task_name, n_points=PATH_POINTS).driven()
                except InputError:
                    continue
                ends = model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)
                driven = drawn.path(task.start, task.q, float(drive.end_min.max()))
                error = driven - model.predict(estimate.values, ends)
                known = predict_from_covariance(estimate, replace(task, cell=estimate.cell)).errors
                largest = float(np.abs(error - known.mean(axis=0)).max())
                left[name][task_name].append(largest)
                beyond |= largest > _UNTOLD * float(known.std(axis=0).max())
            untold[name] += beyond
        for name, errors in left.items():
            parts = [f"{t} {rms(e):6.2f} nm (median {1e3 * np.median(e):6.2f})" for t, e in errors.items() if e]
            counts = f"{number + 1:4} truths, {doubtful[name]} doubtful, {untold[name]} beyond {_UNTOLD:g} sd"
            print(f"{name:20} {counts} " + "  ".join(parts), flush=True)


def rms(errors: list[float]) -> float:
    """Root mean square of errors in um, in nm."""
    return float(1e3 * np.sqrt(np.mean(np.square(errors))))


def parser() -> argparse.ArgumentParser:
    """The options of the study."""

    def names(text: str) -> list[str]:
        return text.split(",")

    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("what", choices=("accuracy", "extrinsic", "machine", "figure"))
    made.add_argument("files", nargs="*", type=Path, help="figure: what accuracy --json wrote")
    made.add_argument("--numbers", type=lambda text: [int(n) for n in text.split(",")], default=[10, 12, 14])
    made.add_argument("--ways", type=names, default=["paper's order", "random", "greedy", "best"])
    made.add_argument("--tasks", type=names, default=list(DEFAULT_TASKS))
    made.add_argument(
        "--against", choices=("endpoints", "midpoints"), default="endpoints", help="of the paper's sweeps"
    )
    made.add_argument("--readings", type=int, default=2, help="of each planned sweep after its start")
    made.add_argument("--draws", type=int, default=256, help="that plans are averaged over")
    made.add_argument("--share", type=int, default=32, help="of these draws for each start of the search")
    made.add_argument("--truths", type=int, default=500, help="that plans are judged on")
    made.add_argument("--tilt", type=float, default=4.3, help="largest tilt of the mirror in deg")
    made.add_argument("--coordinated", action="store_true", help="joints of one controller may move together")
    made.add_argument("--mechanics", choices=("stated", "none"), default="none", help="error motions of the cell")
    made.add_argument("--simulate", action="store_true", help="calibrate every truth from simulated measurements")
    made.add_argument("--noises", type=int, default=1, help="simulated for each truth")
    made.add_argument("--adaptive", type=int, default=0, metavar="TRUTHS", help="plan the second half truth by truth")
    made.add_argument("--hours", type=float, default=24.0, help="since the calibration")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--plans", type=Path, help="folder for the best plans, as CSV and drawn")
    made.add_argument("--json", type=Path, help="accuracy: what is found, for a figure")
    made.add_argument("--figure", type=Path, help="figure to write: .svg or .png")
    return made


def main() -> None:
    """Print the figures."""
    options = parser().parse_args()
    {"accuracy": accuracy, "extrinsic": extrinsic, "machine": machine, "figure": figure}[options.what](options)


if __name__ == "__main__":
    main()
