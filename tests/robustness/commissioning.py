"""Do the sweeps of a commissioning tell what is connected otherwise than the cell says? Random mistakes, one each.

    python tests/robustness/commissioning.py [CASES] [CELL ...]

A cell whose true parameters are drawn from the prior is measured with `fpcal plan --commission`; then a mistake is put
into the file: an axis that counts the other way (or several), two columns swapped, a column in another unit. The answer
is right if the first mistake that the doctor names is it, or if the reader refuses the file and names the joint. Some
files have no mistake: then no problem may be found.
"""

import contextlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.design.commission import commission_plan
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.mistakes import axis_sets, mend, mirror_sets
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import simulate

KINDS = ("none", "sign", "swap", "thousand", "thousandth", "rad", "degrees")


def drawn(cell: Cell, rng: np.random.Generator) -> tuple[str, np.ndarray, set[int]]:
    """A mistake: its kind, what it makes of joint vectors in um and rad, and the joints that it concerns."""
    n, matrix, kind = len(cell.joints), np.eye(len(cell.joints)), str(rng.choice(KINDS))
    moves = commission_plan(cell)
    moved = (moves.q_start != moves.q_end).any(axis=0)
    if kind == "sign":
        sets = axis_sets(cell, moved)
        joints = set(sets[rng.integers(len(sets))])
        for joint in joints:
            matrix[joint, joint] = -1.0
    elif kind == "swap":
        i, j = sorted(rng.choice(n, 2, replace=False).tolist())
        joints, scale = {i, j}, cell.joint_scales
        matrix[[i, j], [i, j]] = 0.0
        # The numbers of a column are read in the unit of the other.
        matrix[i, j], matrix[j, i] = scale[j] / scale[i], scale[i] / scale[j]
    else:
        turning = kind in ("rad", "degrees")
        those = np.flatnonzero((cell.revolute | (not turning)) & moved)
        joint = int(rng.choice(those)) if len(those) else 0
        kind = kind if len(those) else "none"
        factors = {"thousand": 1e3, "thousandth": 1e-3, "rad": np.radians(1.0), "degrees": np.degrees(1.0)}
        joints = {joint} if kind in factors else set()
        matrix[joint, joint] = factors.get(kind, 1.0)
    return kind, matrix, joints


def measured(cell: Cell, rng: np.random.Generator) -> Sweeps:
    """The sweeps of a commissioning on a cell that is drawn from the prior, within 2 standard deviations.

    Draws whose mirror would come behind the fibre are drawn again: no cell is so.
    """
    free = cell.free
    while True:
        away = np.clip(rng.standard_normal(len(free)), -2.0, 2.0)
        truth = Truth(free, np.zeros(1), Prior.of(free).values(away)[None])
        with contextlib.suppress(InputError):
            return simulate(cell, truth, commission_plan(cell), sigma_nm=5.0, seed=int(rng.integers(2**31)))


def verdict(cell: Cell, seed: int) -> tuple[str, bool, str]:
    """Kind of the mistake, whether it is told, and what is said."""
    rng = np.random.default_rng(seed)
    kind, matrix, joints = drawn(cell, rng)
    sweeps = measured(cell, rng)
    wrong = replace(sweeps, q_start=sweeps.q_start @ matrix, q_end=sweeps.q_end @ matrix)
    names = {f"q{joint + 1}" for joint in joints}
    try:
        check_sweeps(wrong, cell)
    except InputError as error:
        return kind, any(f"{name}_" in str(error) for name in names), str(error)
    # As the doctor does, without what it looks at beside the fit.
    found = identify(cell, wrong)
    if found.estimate.trust.usable or kind == "none":
        return kind, found.estimate.trust.usable and kind == "none", found.estimate.trust.against or "no problem"
    mended = mend(found.problem, found.solution, found.fit.standardised)
    said = " or ".join(one.name for one in mended)
    words = {"sign": "the other way", "swap": "swapped"}.get(kind, "stand")
    images = [{f"q{j + 1}" for j in one} for one in mirror_sets(cell)]
    alike = [names, *(names ^ image for image in images)] if kind == "sign" else [names]
    # Mistakes that are the same, such as lengths and all translations negated, fit the same and are named together.
    best = [one.name.split(", that is")[0] for one in mended]
    told = [words in name and {f"q{j + 1}" for j in range(6) if f"q{j + 1}" in name} in alike for name in best]
    return kind, any(told), said


def main(cases: int, cells: list[str]) -> int:
    """Run the cases of each cell; the exit status says whether all were told."""
    missed = 0
    for name in cells:
        cell = load_cell(name, mechanics="none")
        told: dict[str, list[bool]] = {}
        for seed in range(cases):
            kind, right, said = verdict(cell, seed)
            told.setdefault(kind, []).append(right)
            if not right:
                print(f"{name}: case {seed} ({kind}): {said[:300]}", flush=True)
            if seed % 50 == 49:
                print(f"{name}: {sum(map(sum, told.values()))} of {seed + 1}", flush=True)
        counts = ", ".join(f"{kind} {sum(found)} of {len(found)}" for kind, found in sorted(told.items()))
        total = sum(map(sum, told.values()))
        print(f"{name}: {total} of {cases} told: {counts}", flush=True)
        missed += cases - total
    return int(missed > 0)


if __name__ == "__main__":
    data = Path(__file__).parents[1] / "data"
    wanted = sys.argv[2:] or ["femto-st", str(data / "lab7.toml"), str(data / "five_axes.toml")]
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 500, wanted))
