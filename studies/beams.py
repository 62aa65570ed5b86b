"""One beam against three on one mirror: what they see, what is left of the tasks, how many sweeps are needed.

python studies/beams.py [--truths 40] [--sigma-nm 5]

The built-in cells femto-st and three-beams, a perfect mechanism, the same truths from the prior, the paper's sweeps
with end points alone and with midpoints. Printed: rank, and the median over the truths of each task's standard
deviation at its worst point, linearised at the truth; then how many of the paper's sweeps, taken evenly, leave a task
as well known with three beams as all 69 do with one.
"""

import argparse

import numpy as np

from fpcal_bayes import InputError, Sweeps, load_cell, observe, paper_protocol
from fpcal_bayes.infer import linear_task_sd, task_jacobian, whitened_jacobian
from fpcal_bayes.measure import Truth
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.motion import task_path

TASKS = ("circle", "tilt-x", "tilt-z", "spin")
COUNTS = (6, 8, 10, 12, 16, 20, 24, 30, 36, 45, 55, 69)


def some(plan: Sweeps, count: int) -> Sweeps:
    """Evenly taken sweeps of a plan, all rows of each."""
    sweeps = [label.removesuffix("-mid") for label in plan.label.tolist()]
    names = list(dict.fromkeys(sweeps))
    kept = {names[i] for i in np.linspace(0, len(names) - 1, count).round().astype(int)}
    return plan.take(np.array([name in kept for name in sweeps]))


def draw(cell: Cell, rng: np.random.Generator) -> Truth:
    """A truth from the prior with which every task can be driven."""
    while True:
        values = cell.free.nominal + cell.free.prior_sd * rng.standard_normal(len(cell.free))
        try:
            tasks = [task_path(cell, CavityModel.of(cell).vector(values), name, n_points=9) for name in TASKS]
        except InputError:
            continue
        if not all(task.finite.all() for task in tasks):
            continue
        return Truth(cell.free, np.zeros(1), values[None])


def of_one_beam(truth: Truth, cell: Cell) -> Truth:
    """The same truth of a cell with the first beam alone."""
    return Truth(cell.free, truth.times_h, truth.values[:, truth.parameters.positions(cell.free.names)])


def task_sd(cell: Cell, plan: Sweeps, truths: list[Truth], sigma_nm: float) -> np.ndarray:
    """Median over the truths of each task's standard deviation at its worst point, in nm, shape (4,)."""
    model, found = CavityModel.of(cell), []
    measured = plan.with_measurement(np.zeros(len(plan)), 1e-3 * sigma_nm)
    for truth in truths:
        values = truth.values[0]
        jacobian = whitened_jacobian(model, measured, values)
        left = np.linalg.inv(jacobian.T @ jacobian + np.eye(len(cell.free)))
        covariance = left * np.outer(cell.free.prior_sd, cell.free.prior_sd)
        tasks = [task_path(cell, model.vector(values), name, n_points=9) for name in TASKS]
        sd = [linear_task_sd(task_jacobian(model, values, task), covariance).max() for task in tasks]
        found.append([1e3 * each for each in sd])
    return np.median(found, axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=40)
    parser.add_argument("--sigma-nm", type=float, default=5.0)
    options = parser.parse_args()
    cells = [load_cell(name, mechanics="none") for name in ("femto-st", "three-beams")]
    drawn = [draw(cells[1], np.random.default_rng([29, k])) for k in range(options.truths)]
    truths = [[of_one_beam(truth, cells[0]) for truth in drawn], drawn]
    print(f"{'':32}rank   {'   '.join(f'{name:>7}' for name in TASKS)} nm")
    for midpoints in (False, True):
        goal = np.zeros(len(TASKS))
        for cell, own in zip(cells, truths, strict=True):
            plan = paper_protocol(cell, midpoints=midpoints)
            rank = observe(cell, plan).spectrum.rank
            left = task_sd(cell, plan, own, options.sigma_nm)
            goal = goal if goal.any() else left
            name = f"{cell.name}, {'midpoints' if midpoints else 'end points'}"
            print(f"{name:30}{rank:3} of {len(cell.free)}   {'   '.join(f'{sd:7.2f}' for sd in left)}", flush=True)
        plan = paper_protocol(cells[1], midpoints=midpoints)
        left = np.array([task_sd(cells[1], some(plan, count), drawn, options.sigma_nm) for count in COUNTS])
        needed = [COUNTS[int(np.argmax(column <= least))] for column, least in zip(left.T, goal, strict=True)]
        print(f"{'  sweeps that do as well':41}{'   '.join(f'{count:7}' for count in needed)}", flush=True)


if __name__ == "__main__":
    main()
