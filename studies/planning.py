"""Accuracy against the number of sweeps: the paper's order, random, greedy, exchange with refinement, adaptive.

    python studies/planning.py accuracy --numbers 8,10,12,14,16   expected, and simulated with --truths
    python studies/planning.py extrinsic                          the best 1 to 6 sweeps a day after a calibration

Figures are relative to what the paper's 69 end-point sweeps leave; expected ones on draws of the prior that no plan was
made for, simulated ones from the largest error along each task after identifying simulated measurements.
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fpcal_bayes.cli.plan import aged
from fpcal_bayes.control.tasks import find_task
from fpcal_bayes.infer.identify import identify
from fpcal_bayes.infer.planning.candidates import candidate_sweeps
from fpcal_bayes.infer.planning.goals import DEFAULT_TASKS
from fpcal_bayes.infer.planning.ground import Ground, estimate_ground, prior_ground
from fpcal_bayes.infer.planning.limits import SweepLimits
from fpcal_bayes.infer.planning.order import in_short_order
from fpcal_bayes.infer.planning.plan import Planner, PlanSettings
from fpcal_bayes.infer.planning.rows import read_often
from fpcal_bayes.infer.task_error import task_errors
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.rig import simulate
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell, load_cell
from fpcal_bayes.report.plan_figure import draw_plan
from fpcal_bayes.report.week_figure import save_figure

SIGMA = 0.005


@dataclass(frozen=True)
class Grounds:
    """What plans are made on and judged on, and what the paper's sweeps leave there."""

    made: Ground
    judged: Ground
    made_paper: dict[str, float]
    paper: dict[str, float]

    @classmethod
    def of(cls, cell: Cell, draws: int, truths: int, seed: int) -> "Grounds":
        made = prior_ground(cell, draws=draws, seed=seed)
        judged = prior_ground(cell, draws=truths, points=31, seed=seed + 1_000_003)
        papers = [ground.expected_sd(paper_protocol(cell), readings=1) for ground in (made, judged)]
        return cls(made, judged, *papers)

    def ratios(self, sweeps: Sweeps, readings: int = 2) -> dict[str, float]:
        """Expected standard deviations over those after the paper's sweeps."""
        found = self.judged.expected_sd(sweeps, readings=readings)
        return {task: found[task] / self.paper[task] for task in found}


def line(name: str, ratios: dict[str, float]) -> str:
    return f"{name:34}" + "  ".join(f"{task} {ratio:6.2f}" for task, ratio in ratios.items())


def errors(cell: Cell, values: np.ndarray, plan: Sweeps, seed: int) -> dict[str, float]:
    """Largest task errors in um after identifying a simulated cell from simulated measurements."""
    model = CavityModel.of(cell)
    truth = Truth(cell.free, np.zeros(1), values[None])
    found = identify(cell, simulate(cell, truth, plan, sigma=SIGMA, seed=seed)).estimate
    result = {}
    for name in DEFAULT_TASKS:
        task = find_task(cell, found.vector(), name, n_points=31)
        # With an estimate at the edge of what the joints reach there may be no point to drive to.
        error = task_errors(model, values[None], found.values, task.take(task.ok)) if task.ok.any() else np.nan
        result[name] = float(np.abs(error).max())
    return result


def simulated(cell: Cell, grounds: Grounds, plan: Sweeps) -> dict[str, tuple[float, float]]:
    """Root mean square over truths of the largest task error, plan over paper, and the ratio of the medians."""
    ours, theirs = read_often(plan, 2), paper_protocol(cell)
    pairs = [
        (errors(cell, values, ours, seed), errors(cell, values, theirs, seed))
        for seed, values in enumerate(grounds.judged.goals.values)
    ]
    ratios = {}
    for name in DEFAULT_TASKS:
        a, b = np.array([[pair[side][name] for side in (0, 1)] for pair in pairs]).T
        both = np.isfinite(a + b)
        a, b = a[both], b[both]
        ratios[name] = (float(np.sqrt((a**2).mean() / (b**2).mean())), float(np.median(a) / np.median(b)))
    return ratios


def accuracy(options: argparse.Namespace) -> None:
    cell = load_cell()
    grounds = Grounds.of(cell, options.draws, options.truths, options.seed)
    paper = paper_protocol(cell)
    for often, name in ((1, "paper, 69 end points"), (2, "paper, 69 with midpoints")):
        sd = grounds.judged.expected_sd(paper, readings=often)
        print(f"{name}: " + ", ".join(f"{task} {1e3 * value:.2f} nm" for task, value in sd.items()))
    limits = SweepLimits(tilt=float(np.radians(options.tilt)))
    settings = PlanSettings(seed=options.seed, limits=limits, variations=options.variations)
    searched = Planner(grounds.made, settings, grounds.made_paper)
    greedy = Planner(grounds.made, replace(settings, passes=0, variations=0), grounds.made_paper)
    for n in options.numbers:
        random = candidate_sweeps(cell, n=n, rng=np.random.default_rng(options.seed), limits=limits)
        print(line(f"{n} in the paper's order", grounds.ratios(paper.take(np.arange(n)))))
        print(line(f"{n} random", grounds.ratios(random)))
        print(line(f"{n} greedy", grounds.ratios(greedy.best(n).sweeps)))
        began = time.process_time()
        plan = in_short_order(cell, searched.best(n).sweeps, limits)
        name = f"{n} exchanged and refined"
        print(line(name, grounds.ratios(plan)), f" ({time.process_time() - began:.0f} s)", flush=True)
        print(line(f"{n} the same, end points only", grounds.ratios(plan, 1)), flush=True)
        if options.simulate:
            ratios = simulated(cell, grounds, plan)
            print(line(f"{n} simulated, rms", {task: ratio[0] for task, ratio in ratios.items()}))
            print(line(f"{n} simulated, median", {task: ratio[1] for task, ratio in ratios.items()}), flush=True)
        if options.adaptive:
            print(line(f"{n} adaptive, of {options.adaptive} truths", adaptive(cell, grounds, n, options)), flush=True)
        if options.figure is not None:
            save_figure(draw_plan(cell, plan), options.figure)


def adaptive(cell: Cell, grounds: Grounds, n: int, options: argparse.Namespace) -> dict[str, float]:
    """Half of the sweeps are planned before the cell is known, the others on what the first half told."""
    limits = SweepLimits(tilt=float(np.radians(options.tilt)))
    first = Planner(grounds.made, PlanSettings(limits=limits), grounds.made_paper).best(n // 2).sweeps
    ours, theirs = [], []
    for number, values in enumerate(grounds.judged.goals.values[: options.adaptive]):
        truth = Truth(cell.free, np.zeros(1), values[None])
        known = identify(cell, simulate(cell, truth, read_often(first, 2), sigma=SIGMA, seed=number)).estimate
        now = estimate_ground(known)
        second = Planner(now, PlanSettings(limits=limits, seed=number), grounds.made_paper).best(n - n // 2).sweeps
        # Judged at the truth, under the cell's own prior.
        there = grounds.judged.at_draws(np.array([number]))
        ours.append(there.expected_sd(join([first, second])))
        theirs.append(there.expected_sd(paper_protocol(cell), readings=1))
    return {
        task: float(np.sqrt(np.mean([a[task] ** 2 for a in ours]) / np.mean([b[task] ** 2 for b in theirs])))
        for task in DEFAULT_TASKS
    }


def extrinsic(options: argparse.Namespace) -> None:
    """Best few sweeps some hours after a calibration at the paper's truth."""
    cell = load_cell()
    calibration = simulate(
        cell, paper_truth(cell), paper_protocol(cell, midpoints=True), sigma=SIGMA, seed=options.seed
    )
    ground = estimate_ground(aged(identify(cell, calibration).estimate, options.hours))
    paper = ground.expected_sd(paper_protocol(cell), readings=1)
    for name, sd in (("before", ground.expected_sd(None)), ("paper's 69", paper)):
        print(f"{name:34}" + "  ".join(f"{task} {1e3 * value:6.2f} nm" for task, value in sd.items()))
    for n in range(1, 7):
        sd = Planner(ground, PlanSettings(seed=options.seed), paper).best(n).sd
        print(f"{n:<34}" + "  ".join(f"{task} {1e3 * value[-1]:6.2f} nm" for task, value in sd.items()), flush=True)


def parser() -> argparse.ArgumentParser:
    """The options of the study."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("what", choices=("accuracy", "extrinsic"))
    made.add_argument("--numbers", type=lambda text: [int(n) for n in text.split(",")], default=[10, 12, 14])
    made.add_argument("--draws", type=int, default=64, help="that plans are averaged over")
    made.add_argument("--truths", type=int, default=100, help="that plans are judged on")
    made.add_argument("--tilt", type=float, default=4.3, help="largest tilt of the mirror in deg")
    made.add_argument("--variations", type=int, default=30, help="of each sweep in a round of refinement")
    made.add_argument("--simulate", action="store_true", help="calibrate every truth from simulated measurements")
    made.add_argument("--adaptive", type=int, default=0, metavar="TRUTHS", help="plan the second half truth by truth")
    made.add_argument("--hours", type=float, default=24.0, help="since the calibration")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--figure", type=Path, help="draw the last plan: .svg or .png")
    return made


def main() -> None:
    """Print the figures."""
    options = parser().parse_args()
    {"accuracy": accuracy, "extrinsic": extrinsic}[options.what](options)


if __name__ == "__main__":
    main()
