"""What fresh sweeps would show: the power to find an error that brings a task beyond its tolerance.

The errors are those of the mechanics of real machines, one kind at a time: unknown functions of the joints of a group,
drawn anew many times. The fit takes up part of each; what it leaves shows in the task and in the fresh rows. Each is
scaled until the task is off by the tolerance and by three times its own band; the score is then noncentral chi-square.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, special

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.error import task_jacobian
from fpcal_bayes.infer.verification.expected import Expected
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.model.cell.error_motions import JointMechanics, Mechanics
from fpcal_bayes.model.mechanics import Terms, design
from fpcal_bayes.model.mechanics.design import path_design
from fpcal_bayes.model.mechanics.terms import group_of
from fpcal_bayes.motion.tasks import Task

#: Probability of calling a good calibration bad.
LEVEL = 0.005
#: A task is off by so many times its band before the error counts.
BEYOND_BAND = 3.0
#: Errors of so many times the sizes below are none that a machine has.
_ABSURD = 300.0
_DRAWS = 40
_GROUPS = {"stage": "stages", "goniometers": "goniometers", "rotary": "rotary joint"}
#: Sizes of a machine that nobody has looked at: what a sheet of good stages states, the lever from the sheet's point.
_UNSEEN = {
    "prismatic": JointMechanics(
        straightness_nm=30.0, pitch_urad=2.0, yaw_urad=2.0, roll_urad=2.0, linearity=30.0, reversal=10.0,
        lever_mm=(80.0, 80.0, 80.0),
    ),
    "revolute": JointMechanics(
        radial_runout_nm=100.0, axial_runout_nm=100.0, wobble_urad=10.0, linearity=10.0, reversal=1.0
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Effects:
    """Errors that a machine may have, as a task and the rows feel them once the fit has taken up its part."""

    names: tuple[str, ...]  # kind of each error, (n_effects,)
    rows: Floats  # what it adds to the fresh rows, in um, shape (n_effects, n_fresh): scaled to be just worth finding

    def power(self, covariance: Floats) -> dict[str, float]:
        """Probability of finding each kind of error with fresh rows of `covariance` (n_fresh, n_fresh), at `LEVEL`."""
        white = linalg.solve_triangular(linalg.cholesky(covariance, lower=True), self.rows.T, lower=True)
        found = power_of((white**2).sum(axis=0), len(covariance))
        kinds = np.array(self.names)
        return {name: float(found[kinds == name].mean()) for name in dict.fromkeys(self.names)}


def power_of(excess: Floats, n_rows: int) -> Floats:
    """Probability that a score of `n_rows` fails at `LEVEL` when its mean is raised by `excess`."""
    return np.asarray(1.0 - special.chndtr(special.chdtri(n_rows, LEVEL), n_rows, excess))


def effects_of(expected: Expected, tasks: Sequence[tuple[Task, float, float]], *, seed: int = 0) -> dict[str, Effects]:
    """Errors that bring each of `tasks` (path, tolerance, upper edge of the band, in um) beyond it, by its name."""
    problem, rng = expected.problem, np.random.default_rng([seed, 7])
    model, cell = problem.model, problem.model.cell
    vector = model.vector(values := problem.values(expected.unknowns))
    sizes = Mechanics(tuple(_unseen(cell.mechanics, i, joint.kind) for i, joint in enumerate(cell.joints)))
    terms = Terms.of(cell, sizes, model.free.names)
    driven = drive_of_sweeps(problem.sweeps, sizes.minutes_per_sweep, terms.still)
    made = design(terms, vector, driven, problem.sweeps.sigma)
    # A weight's word and the group of its joint say the kind of error.
    parts = [name.partition(" of q") for name in made.names[: made.motion_count]]
    groups = [group_of(cell, int("".join(c for c in joint if c.isdigit())) - 1) for _, _, joint in parts]
    kinds = [f"{w.partition(',')[0]} of the {_GROUPS[g]}" for (w, *_), g in zip(parts, groups, strict=True)]
    matrix = made.matrix[:, : made.motion_count]
    fitted = expected.fitted
    left_in_rows = matrix[~fitted] - expected.known[0] @ matrix[fitted]

    known = expected.taken_up
    n_weights = len(known) - expected.geometry.shape[1]
    result = {}
    for task, tolerance, band in tasks:
        by_score = problem.prior.by_scores(task_jacobian(model, values, task), expected.unknowns)
        own = np.zeros((len(task), n_weights))
        if expected.terms is not None and expected.design is not None:
            path = path_design(expected.terms, vector, task.start, task.q).motions
            own[:, : path.shape[1]] = path * np.exp(expected.typical)[expected.design.scale[: path.shape[1]]]
        taken_up = np.hstack([by_score, own]) @ (known @ matrix[fitted])
        left = path_design(terms, vector, task.start, task.q).motions - taken_up
        names, found = [], []
        for kind in dict.fromkeys(kinds):
            weights = rng.standard_normal((_DRAWS, len(kinds))) * (np.array(kinds) == kind)
            size = max(tolerance, BEYOND_BAND * band) / np.maximum(np.ptp(weights @ left.T, axis=1), 1e-15)
            if np.median(size) > _ABSURD:
                continue
            names += [kind] * _DRAWS
            found.append(size[:, None] * (weights @ left_in_rows.T))
        result[task.name] = Effects(tuple(names), np.vstack([np.zeros((0, len(left_in_rows))), *found]))
    return result


def _unseen(sizes: Mechanics | None, joint: int, kind: str) -> JointMechanics:
    """Sizes of the errors that a joint may have: its own where they are stated."""
    if sizes is not None and sizes.joints[joint].any:
        return replace(sizes.joints[joint], return_sd=0.0, encoder=0.0)
    return _UNSEEN[kind]
