"""Does what a plan promises come true of its own file? Measured as the file says, identified, and asked for the tasks.

    python tests/robustness/plans.py [PLANS] [TRUTHS] [FIRST]

Each plan, of random size and 2, 3 or 4 readings, on the built-in cell, one of a 60 um cavity, one of five axes or one
from random words, is written and read again as `fpcal simulate --protocol` does, on cells drawn from the prior. Three
ratios to the expected variance of the worst point, each 1 on average if the promise holds: what the covariance states,
what the middle 68 % of the draws that `fpcal task-error` takes state (a second solution of small weight stands outside
these), and the square of the error that there is.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from cells import DATA, SIDES, light_plan, random_words, run

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.design.problem import DEFAULT_TASKS, POINTS, prior_ground
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.infer.posterior.draws import independent_draws
from fpcal_bayes.infer.tasks.error import linear_task_sd, task_errors, task_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.io.tickets import write_plan
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Ticket
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.axes import home
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import find_task, possible_tasks
from fpcal_bayes.simulator.sweeps import simulate

#: Of the cell with the cavity of 60 um: plans of a cell without one may drive the mirror through the fibre.
ENVELOPE = """
[envelope]
least_gap_um = 15.0
mirror_radius_um = 2500.0
max_tilt_deg = 20.0
max_fringe_rate_hz = 1000.0
gap_um = 60.0
gap_sd_um = 1.0
"""


def cell_file(rng: np.random.Generator, number: int, folder: Path) -> str:
    """A cell of each kind in turn."""
    bounded = folder / "lab7.toml"
    bounded.write_text((DATA / "lab7.toml").read_text() + ENVELOPE)
    known = ("femto-st", str(bounded), str(DATA / "five_axes.toml"))
    if number % 4 < 3:
        return known[number % 4]
    words, side = random_words(rng), str(rng.choice(SIDES)).replace("-", "minus-")
    path = folder / "own.toml"
    path.unlink(missing_ok=True)
    run("cell", "--new", words, "--side", side, "--gap-um", 300, "--gap-sd-um", 5, "-o", path)
    return str(path)


def drawn_truth(cell: Cell, rng: np.random.Generator) -> np.ndarray:
    """Parameters from the prior, given the gap that the envelope states within two of its standard deviations."""
    envelope, prior, model = cell.envelope, Prior.of(cell.free), CavityModel.of(cell.with_opd("axis"))
    values = prior.values(rng.standard_normal((5000, len(cell.free))))
    if envelope is None or envelope.gap is None or envelope.gap_sd is None:
        return values[0]
    lengths = model.predict(values, model.pose_rows(home(cell)[None]))[:, 0]
    return values[int(np.argmax(np.abs(lengths - envelope.gap) < 2.0 * envelope.gap_sd))]


def ratios(
    cell: Cell, expected: dict[str, float], values: np.ndarray, rows: Sweeps, seed: int
) -> tuple[list[list[float]], bool]:
    """The three ratios of each task for one truth, and whether there are draws."""
    found = identify(cell, simulate(cell, Truth(cell.free, np.zeros(1), values[None]), rows, sigma_nm=5.0, seed=seed))
    estimate, model, each = found.estimate, CavityModel.of(cell), []
    draws = independent_draws(found)
    for name, sd in expected.items():
        task = find_task(cell, estimate.vector(), name, n_points=POINTS)
        task = task.take(task.ok)
        if len(task) == 0:
            raise InputError(f"task {name!r} is out of reach")
        linear = linear_task_sd(task_jacobian(model, estimate.values, task), estimate.covariance)
        worst = int(np.argmax(linear))
        error = task_errors(model, values[None], estimate.values, task.take(np.array([worst])))[0, 0]
        middle = linear[worst]
        if len(draws):
            low, high = np.quantile(task_errors(model, draws, estimate.values, task), [0.1587, 0.8413], axis=0)
            middle = float((high - low).max() / 2.0)
        each.append([(linear[worst] / sd) ** 2, (middle / sd) ** 2, (error / sd) ** 2])
    return each, len(draws) > 0


def main(plans: int, truths: int, first: int) -> int:
    """Each plan's ratios, and whether they are 1 on average within three standard errors."""
    means = []
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        for number in range(first, first + plans):
            rng = np.random.default_rng(number)
            cell = load_cell(cell_file(rng, number, folder), mechanics="none")
            readings, n = 2 + number // 4 % 3, int(rng.integers(10, 21))
            tasks = possible_tasks(cell, DEFAULT_TASKS) or possible_tasks(cell)
            made, judged = (prior_ground(cell, tasks=tasks, draws=16, seed=seed) for seed in (number, number + 10_000))
            write_plan(folder / "p.csv", Ticket("p", light_plan(made, n), np.full(n, readings)), cell)
            whole = read_sweeps(folder / "p.csv", cell, plan=True, whole=True)
            expected = judged.expected_sd(whole, readings=readings)
            rows = read_sweeps(folder / "p.csv", cell, plan=True)
            found, said, without = [], "", 0
            for seed in range(truths):
                try:
                    each, drawn = ratios(cell, expected, drawn_truth(cell, rng), rows, seed)
                except InputError as error:
                    said = f"; not measured: {error}"
                    continue
                found.append(each)
                without += not drawn
            head = f"{number} {cell.name} {n} sweeps, {readings} readings, {len(found)} truths, {without} without draws"
            if found:
                by_task = np.mean(found, axis=0)
                means.append(by_task.mean(axis=0))
                head += ": " + ", ".join(
                    f"{task} {a:.2f} {b:.2f} {c:.2f}" for task, (a, b, c) in zip(expected, by_task, strict=True)
                )
            print(f"{head}{said[:160]}", flush=True)
    table = np.array(means)
    centre, error = table.mean(axis=0), table.std(axis=0, ddof=1) / np.sqrt(len(table))
    words = zip(("covariance", "draws", "true"), centre, error, strict=True)
    print(f"{len(table)} plans: " + ", ".join(f"{name} {c:.3f} +- {e:.3f}" for name, c, e in words))
    return int(len(table) < plans or bool((np.abs(centre - 1.0) > 3.0 * error).any()))


if __name__ == "__main__":
    sys.exit(main(*(int(text) for text in [*sys.argv[1:], *("40", "3", "0")[len(sys.argv) - 1 :]])))
