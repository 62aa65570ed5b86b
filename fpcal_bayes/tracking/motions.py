"""The error motions of a machine as states that stay from session to session.

A cell's error motions have some two hundred weights; a cavity length feels a few tens of their combinations. Those are
the states: w = basis z + rest, z of unit prior variance at the sizes that the calibration found. What the rest adds to
a row, and what is new in each session (its drift, a first approach, slow readings), counts as noise.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.mechanics.known import numbered, random_poses
from fpcal_bayes.infer.mechanics.marginal import MarginalWhitening
from fpcal_bayes.infer.mechanics.rows import RowNoise
from fpcal_bayes.infer.mechanics.scales import LOG_SD, LOG_SD_NOISE
from fpcal_bayes.infer.tasks.pose import without_common_turn
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.mechanics import Design, PathDesign, Terms, design, path_design
from fpcal_bayes.model.mechanics.compensation import compensated_path
from fpcal_bayes.model.mechanics.design import pose_designs
from fpcal_bayes.model.mechanics.errors import approached, drifted, returned_errors
from fpcal_bayes.model.mechanics.knowledge import MechanicsKnowledge
from fpcal_bayes.model.mechanics.terms import DRIFT_ORDER, SINGLE_KINDS
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.motion.tasks import Task

#: Combinations whose effect on the cavity length is below this, in um, root mean square over poses, are noise.
_NEGLIGIBLE = 0.7e-3
_MOST_STATES = 56
#: Draws of a state that travel with an estimate.
_DRAWS = 400
#: So many sets of rows are remembered, of at most so many rows each: those of past sessions are asked for each time.
_REMEMBERED, _FEW = 256, 64


@dataclass(frozen=True, repr=False)
class MotionStates(Brief):
    """What the states of the error motions stand for."""

    terms: Terms  # the weights of the cell
    # logarithms of the factors on the stated sizes, as the calibration found them: draws, shape (n_draws, n_scales)
    log_scales: Floats
    session_min: float  # how long the calibration took, in minutes

    @classmethod
    def of(cls, fit: MechanicsFit) -> "MotionStates":
        """As a calibration found them."""
        return cls(fit.terms, np.round(fit.scales.log, 3), float(fit.drive.end_min.max()))

    @cached_property
    def factors(self) -> Floats:
        """Factors on the stated sizes (n_scales,): those that the calibration found, drawn back to the sheet."""
        # A calibration's few points on a function tell little of it between them: none is taken as smaller than stated,
        # and all as large as the root mean square over what remains unknown of their size.
        found, prior = self.log_scales.var(axis=0), np.full(self.log_scales.shape[1], LOG_SD**2)
        prior[-1] = LOG_SD_NOISE**2
        told = np.maximum(1.0 / found - 1.0 / prior, 0.0) + 1.0 / LOG_SD_NOISE**2
        factors = np.exp(self.log_scales.mean(axis=0) / found / told)
        sized = slice(-len(SINGLE_KINDS))
        factors[sized] = np.maximum(factors[sized], 1.0) * np.exp(1.0 / told[sized])
        return np.asarray(factors)

    @cached_property
    def _any_row(self) -> Design:
        """Names and scales of the weights: they are the same for any rows."""
        n = len(self.terms.cell.joints)
        row = Sweeps.of_um_rad(np.zeros((1, n)), np.eye(n)[:1])
        return design(self.terms, self.terms.cell.parameters.nominal, drive_of_sweeps(row, 1.0), np.ones(1))

    @cached_property
    def sizes(self) -> Floats:
        """Standard deviations of the weights in units of their stated sizes, shape (n_weights,)."""
        return np.asarray(self.factors[self._any_row.scale[: self._any_row.motion_count]])

    @cached_property
    def directions(self) -> Floats:
        """Orthonormal combinations of weights of unit variance, the most felt first, shape (n_weights, n_states)."""
        middle, poses = random_poses(self.terms.cell, np.random.default_rng(4))
        felt = path_design(self.terms, self.terms.cell.parameters.nominal, middle, poses).motions * self.sizes
        _, effect, vectors = np.linalg.svd(felt, full_matrices=False)
        count = int((effect > _NEGLIGIBLE * np.sqrt(len(poses))).sum())
        return np.ascontiguousarray(vectors[: min(count, _MOST_STATES)].T)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.directions.shape[1])

    @property
    def basis(self) -> Floats:
        """Weights, in units of their stated sizes, by states, shape (n_weights, n_states)."""
        return self.sizes[:, None] * self.directions

    @cached_property
    def _made(self) -> dict[tuple[bytes, ...], tuple[MarginalWhitening, Floats]]:
        return {}

    def rows(self, model: CavityModel, sweeps: Sweeps, values: Floats) -> tuple[MarginalWhitening, Floats]:
        """Whitening of a session's rows, and their derivatives by the states (n_rows, n_states), in um, at `values`."""
        vector = model.vector(values)
        columns = (getattr(sweeps, each.name) for each in fields(sweeps) if each.name not in ("file", "rows"))
        key = (vector.tobytes(), *(column.tobytes() for column in columns))
        if key in self._made:
            return self._made[key]
        drive = drive_of_sweeps(sweeps, self.terms.sizes.minutes_per_sweep, self.terms.still)
        made = design(self.terms, vector, drive, sweeps.sigma)
        n = made.motion_count
        shared = made.matrix[:, :n] * self.sizes
        felt = shared @ self.directions
        own = made.matrix[:, n:] * self.factors[made.scale[n:]]
        noise = RowNoise.of(sweeps, made).whitening(float(self.factors[-1]), float(self.factors[-2]))
        made_of = MarginalWhitening.around(noise, np.hstack([own, shared - felt @ self.directions.T])), felt
        if len(sweeps) <= _FEW:
            self._made[key] = made_of
            if len(self._made) > _REMEMBERED:
                del self._made[next(iter(self._made))]
        return made_of

    def path(
        self, vector: Floats, mean: Floats, task: Task, n_draws: int, compensate: bool
    ) -> tuple[Task, Floats, Floats]:
        """A task as it is driven at the states' `mean`, and what the states and all else add along it, in um.

        Derivatives by the states (n_points, n_states); draws of what is new each time beside what stays of the mean
        (n_points, n_draws).
        """
        if compensate:
            factor = float(self.factors[-2])
            q, added = compensated_path(self.terms, vector, self.basis @ mean, task.start, task.q, return_factor=factor)
            task = replace(task, q=q, added=added)
        states, new = self._along(path_design(self.terms, vector, task.start, task.q), n_draws)
        return task, states, new + (states @ mean + (0.0 if task.added is None else task.added))[:, None]

    def pose_path(
        self, model: CavityModel, values: Floats, mean: Floats, task: Task, n_draws: int
    ) -> tuple[Floats, Floats]:
        """The same for changes of pose (see `PoseErrors`): (n_states, n_points, 5) and (n_draws, n_points, 5)."""
        paths = pose_designs(self.terms, model.vector(values), task.start, task.q)
        states, new = (np.stack(part, axis=-1) for part in zip(*(self._along(p, n_draws) for p in paths), strict=True))
        states, new = (without_common_turn(model, values, task, np.moveaxis(x, 1, 0)) for x in (states, new))
        return states, new + np.tensordot(mean, states, axes=1)

    def _along(self, path: PathDesign, n_draws: int) -> tuple[Floats, Floats]:
        """Derivatives by the states, (n_points, n_states), and draws of all else, (n_points, n_draws)."""
        felt = path.motions * self.sizes
        states = felt @ self.directions
        rng, log = np.random.default_rng(6), np.repeat(np.log(self.factors)[None], n_draws, axis=0)
        drift = self.factors[self.terms.scales.index("drift")] * rng.standard_normal((n_draws, 3 * DRIFT_ORDER))
        new = drifted(self.terms, path, drift, self.session_min, rng)
        for kind in (approached, returned_errors):
            new = sum(kind(self.terms, path, log, rng).values(), new)
        rest = felt - states @ self.directions.T
        return states, (new + rng.standard_normal((n_draws, rest.shape[1])) @ rest.T).T

    def knowledge(
        self, parameters: ParameterSet, scale: Floats, mean: Floats, covariance: Floats
    ) -> MechanicsKnowledge:
        """What the states that lengths depend on say of `parameters` in units of `scale`, and of the weights."""
        made, n = self._any_row, len(parameters)
        drifting = [i for i, name in enumerate(made.names) if name.startswith("drift along")]
        root, count = covariance_root(covariance), len(drifting)
        to_names = linalg.block_diag(np.diag(scale), self.basis, np.diag(self.factors[made.scale[drifting]]))
        factor = to_names @ linalg.block_diag(root, np.eye(count))
        at = np.concatenate([np.zeros(n), mean[n:], np.zeros(count)])
        draws = np.random.default_rng(5).standard_normal((_DRAWS, factor.shape[1]))
        weights = numbered([*made.names[: made.motion_count], *(made.names[i] for i in drifting)])
        names, log = (*parameters.names, *weights), self.log_scales[np.arange(_DRAWS) % len(self.log_scales)]
        known = self.terms.sizes, self.terms.free, names, to_names @ at, factor, draws
        return MechanicsKnowledge(*known, self.terms.scales, log, self.session_min)
