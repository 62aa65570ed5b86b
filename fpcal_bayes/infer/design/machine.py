"""The error motions of a machine as the design sees them: what a sweep tells of them, and what they leave of a task.

They act linearly on the cavity length (see `model.mechanics`), at the sizes that the cell states. Their responses are
taken at one point, since they hardly depend on where the geometry stands.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.fit.noise import Whitening
from fpcal_bayes.infer.mechanics.marginal import MarginalWhitening
from fpcal_bayes.infer.mechanics.rows import RowNoise
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.mechanics import Terms, design, path_design
from fpcal_bayes.model.mechanics.design import at_poses
from fpcal_bayes.model.mechanics.response import responses

#: Combinations of weights that change rows and tasks by less than this, in um, root mean square, are left out.
_NEGLIGIBLE = 6e-4


@dataclass(frozen=True)
class Machine:
    """Error motions of a cell, by a state of unit covariance."""

    terms: Terms
    vector: Floats  # where responses are taken, shape (model size,)
    basis: Floats  # from the state to the weights that a task shares, shape (n_weights, n)
    _last: dict[bytes, list[tuple[Floats, Floats]]] = field(default_factory=dict, compare=False)  # columns at poses

    @property
    def reversing(self) -> Ints:
        """Joints whose direction of approach counts, by position."""
        return np.flatnonzero(self.terms.reversal > 0).astype(np.int64)

    def rows(self, poses: Floats) -> Floats:
        """What the state adds at poses (n_sweeps, places, n_joints), (n_sweeps, n_beams (places - 1), n), by beam."""
        sides, parts = np.sign(poses[:, -1] - poses[:, 0])[:, None], []
        for at, drive in self._columns(poses):
            columns = np.concatenate([at[:, 1:] - at[:, :1], (drive * self.terms.reversal)[:, 1:] * sides], axis=-1)
            wanted = np.concatenate([np.arange(at.shape[-1]), at.shape[-1] + self.reversing])
            parts.append(columns[..., wanted] @ self.basis)
        return np.concatenate(parts, axis=1)

    def seen(self, poses: Floats, pulls: Floats) -> Floats:
        """What pulls (n_sweeps, n_rows, n) on the rows make of poses (n_sweeps, places, n_variants, n_joints)."""
        sides, total = np.sign(poses[:, -1:, :1] - poses[:, :1, :1]), np.zeros(poses.shape[:3])
        columns = self._columns(poses)
        for (at, drive), pull in zip(columns, np.split(pulls, len(columns), axis=1), strict=True):
            by_weight = pull @ self.basis.T
            own = by_weight[..., : at.shape[-1]]
            by_pose = np.concatenate([-own.sum(axis=1, keepdims=True), own], axis=1)
            result: Floats = np.einsum("spvm,spm->spv", at, by_pose, optimize=True)
            reversal = (drive * self.terms.reversal * sides)[:, 1:, :, self.reversing]
            result[:, 1:] += np.einsum("spvj,spj->spv", reversal, by_weight[..., at.shape[-1] :])
            total += result
        return total

    def noise(self, poses: Floats) -> Floats:
        """Covariance of what is new in each sweep, beside its readings, in um^2, shape (n_sweeps, n_rows, n_rows)."""
        terms, k = self.terms, poses.shape[1] - 1
        drive = np.stack([drive for _, drive in self._columns(poses)], axis=1)
        moved = (poses[:, -1] != poses[:, 0])[:, None, None]
        reached = drive * np.hypot(terms.return_sd, np.where(np.isfinite(terms.encoder_period), 0.0, terms.encoder))
        ends, lost = np.where(moved, reached, 0.0), drive * terms.reversal
        # A joint that stands still keeps its error through the sweep; one that moves had another one at the start.
        started = np.concatenate([ends[:, :, :1], np.where(moved, lost[:, :, :1], 0.0)], axis=-1) + np.zeros((k, 1))
        kept = [np.where(moved, 0.0, part[:, :, 1:] - part[:, :, :1]) for part in (reached, lost)]
        common = np.concatenate([started, *kept], axis=-1)
        common = common.reshape(len(poses), -1, common.shape[-1])
        drift = 0.5e-3 * terms.sizes.drift_nm_per_min * terms.sizes.minutes_per_sweep * (np.arange(1, k + 1) / k)
        noise: Floats = common @ common.transpose(0, 2, 1) + np.kron(np.eye(drive.shape[1]), np.outer(drift, drift))
        return noise + felt_alike(ends[:, :, 1:])

    def whitened(self, sweeps: Sweeps, geometry: Floats) -> Floats:
        """Rows of a plan as driven, in their order, by the state, with what `geometry` (n_draws, n_rows, n) adds."""
        drive = drive_of_sweeps(sweeps, self.terms.sizes.minutes_per_sweep)
        made = design(self.terms, self.vector, drive, sweeps.sigma)
        base: Whitening = RowNoise.of(sweeps, made).whitening()
        shared = made.motion_count
        whitening = MarginalWhitening.around(base, made.matrix[:, shared:])
        return whitening.apply(geometry + made.matrix[:, :shared] @ self.basis)

    def _columns(self, poses: Floats) -> list[tuple[Floats, Floats]]:
        """Of each beam: columns at poses (..., n_joints), responses to the joints' own travel; the last are kept."""
        key = poses.tobytes()
        if key not in self._last:
            flat, cell, found = poses.reshape(-1, poses.shape[-1]), self.terms.cell, []
            for beam in range(len(cell.beams)):
                at = responses(cell, self.vector, self.terms.told, flat, np.full(len(flat), beam))
                columns = at_poses(self.terms, flat, at)
                found.append((columns.reshape(*poses.shape[:-1], -1), at.drive.reshape(poses.shape)))
            self._last.clear()
            self._last[key] = found
        return self._last[key]


def felt_alike(felt: Floats) -> Floats:
    """Covariance by joint errors `felt` (n_sweeps, n_beams, places, n_joints), beam by beam, anew at each place."""
    n, beams, k, _ = felt.shape
    shared = (felt[:, :, None] * felt[:, None]).sum(axis=-1)
    return np.asarray((shared.swapaxes(2, 3)[..., None] * np.eye(k)[:, None]).reshape(n, beams * k, beams * k))


def motions_of_path(terms: Terms, vector: Floats, start: Floats, q: Floats) -> tuple[Floats, Floats]:
    """What shared weights (n_points, n_weights) and errors that no sweep tells (n_points,), one sd, add to a path."""
    path = path_design(terms, vector, start, q)
    encoders = path.encoded[1:] ** 2 + path.encoded[:1] ** 2 * (path.places[1:] != path.places[:1])
    unknown = path.unknown_side**2 + path.returned_start**2 + path.returned_point**2 + encoders
    return path.motions, np.sqrt(unknown.sum(axis=1))


def prior_machine(terms: Terms, vector: Floats, poses: Floats, tasks: Floats, n_parameters: int) -> Machine:
    """The machine before any measurement: parameters, then what sweeps at `poses` or `tasks` (.., n_weights) feel."""
    every = Machine(terms, vector, np.eye(tasks.shape[1]))
    effects = np.concatenate([*every.rows(poses), tasks])
    values, vectors = linalg.eigh(effects.T @ effects / len(effects))
    felt = vectors[:, values > _NEGLIGIBLE**2][:, ::-1]
    return replace(every, basis=np.hstack([np.zeros((len(felt), n_parameters)), felt]))
