"""What candidate sweeps and tasks look like to the design: derivatives by the free parameters, over draws."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.design.machine import Machine, felt_alike
from fpcal_bayes.infer.fit.noise import whitening_of
from fpcal_bayes.measure.protocol import read_often, seen_by_all
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel

#: A whole trace is planned as readings at so many places, which together tell as much as so many independent ones: the
#: errors of a fringe fit are alike over a stretch of the trace.
TRACE_PLACES, TRACE_READINGS = 6, 32


def sweep_rows(
    model: CavityModel, values: Floats, sweeps: Sweeps, *, readings: int = 2, sigma: float = 0.005
) -> Floats:
    """Whitened derivatives of the rows of whole sweeps, shape (n_draws, n_sweeps, n_rows, n_free), per um or rad.

    They are linearised at `values` (n_draws, n_free), in um and rad. There are `readings` of each sweep after its
    start, by every beam: 1 end point, 2 midpoint and end point, and so on, of standard deviation `sigma` in um.
    """
    plan = seen_by_all(read_often(sweeps, readings), model.cell)
    whitened = plan_rows(model, values, replace(plan, sigma=np.full(len(plan), sigma)))
    return whitened.reshape(len(whitened), len(sweeps), readings * len(model.cell.beams), -1)


def plan_rows(model: CavityModel, values: Floats, sweeps: Sweeps) -> Floats:
    """Whitened derivatives of the rows of a plan with standard deviations, shape (n_draws, n_rows, n_free)."""
    rows = sweeps.laid_out(model)
    values = np.atleast_2d(values)
    _, jacobians = model.predict_with_jacobian(values, rows)
    whitening = whitening_of(model, sweeps, values[0])
    if not model.cell.repeatability.any():
        return whitening.apply(jacobians)
    # What the joints' repeatability adds depends on where the rows are linearised.
    parts: Sequence[Floats] = [
        whitening_of(model, sweeps, point).apply(jacobian) for point, jacobian in zip(values, jacobians, strict=True)
    ]
    return np.array(parts)


@dataclass(frozen=True)
class SweepRows:
    """Whitened rows of sweeps by the state: what is unknown, in units in which its covariance is the identity."""

    model: CavityModel
    values: Floats  # where rows are linearised, shape (n_draws, n_free), in um and rad
    centre: Floats  # where the noise of the joints is, shape (n_free,)
    root: Floats  # of the covariance of the free parameters, shape (n_free, n)
    readings: int  # places after the start, each read by every beam
    sigma: float  # standard deviation of a row in um
    machine: Machine | None = None  # error motions, by the same state

    def of(self, sweeps: Sweeps) -> Floats:
        """Rows of each sweep, beam by beam, shape (n_draws, n_sweeps, n_beams readings, n)."""
        poses = self._poses(sweeps)
        at = self._at(poses.reshape(-1, poses.shape[-1])).reshape(len(self.values), self._beams, *poses.shape[:2], -1)
        rows = (at[:, :, :, 1:] - at[:, :, :, :1]).swapaxes(1, 2).reshape(len(at), len(sweeps), -1, at.shape[-1])
        if self.machine is not None:
            rows += self.machine.rows(poses)
        return self._whitening(poses) @ rows

    def slope(self, sweeps: Sweeps, by_rows: Floats, steps: Floats) -> Floats:
        """Derivative by sweep ends, (2, n_sweeps, n_joints), from that by rows; `steps` (n_joints,) of differences."""
        poses = self._poses(sweeps)
        n_sweeps, places, n_joints = poses.shape
        pulls = self._whitening(poses).transpose(0, 2, 1) @ by_rows
        each = pulls.reshape(len(pulls), n_sweeps, self._beams, places - 1, -1).swapaxes(1, 2)
        by_pose = np.concatenate([-each.sum(axis=3, keepdims=True), each], axis=3) @ self.root.T
        by_pose = by_pose.reshape(len(pulls), self._beams, n_sweeps * places, -1)
        flat, values = poses.reshape(-1, n_joints), self.values[: len(pulls)]
        each_beam = [self.model.joint_pulls(values, flat, by_pose[:, b], b, steps) for b in range(self._beams)]
        slope: Floats = np.sum(each_beam, axis=0).reshape(poses.shape)
        if self.machine is not None:
            further = poses[:, :, None] + np.vstack([np.zeros(n_joints), np.diag(steps)])
            seen = self.machine.seen(further, pulls.sum(axis=0))
            slope += (seen[..., 1:] - seen[..., :1]) / steps
        share = np.linspace(0.0, 1.0, places)
        return np.stack([np.einsum("p,spj->sj", part, slope) for part in (1.0 - share, share)])

    def _poses(self, sweeps: Sweeps) -> Floats:
        """Start and readings of each sweep, shape (n_sweeps, readings + 1, n_joints)."""
        share = np.linspace(0.0, 1.0, self.readings + 1)[:, None]
        return sweeps.q_start[:, None] * (1.0 - share) + sweeps.q_end[:, None] * share

    @property
    def _beams(self) -> int:
        return len(self.model.cell.beams)

    def _at(self, q: Floats) -> Floats:
        """Derivatives of the lengths at poses (n_poses, n_joints) by the state, (n_draws, n_beams n_poses, n)."""
        seen = self.model.pose_rows(np.tile(q, (self._beams, 1)), np.repeat(np.arange(self._beams), len(q)))
        _, jacobian = self.model.predict_with_jacobian(self.values, seen)
        n = len(self.root)
        if self.root.shape == (n, n) and np.count_nonzero(self.root) == np.count_nonzero(np.diag(self.root)):
            return jacobian * np.diag(self.root)
        return jacobian @ self.root

    def _whitening(self, poses: Floats) -> Floats:
        """Maps that whiten the rows of each sweep, shape (n_sweeps, n_rows, n_rows)."""
        cell, k, beams = self.model.cell, self.readings, self._beams
        one = np.kron(np.eye(beams), 0.5 * self.sigma**2 * (np.eye(k) + 1.0))
        noise = np.broadcast_to(one, (len(poses), *one.shape)).copy()
        if self.machine is not None:
            noise += self.machine.noise(poses)
        elif cell.repeatability.any():
            flat = poses.reshape(-1, poses.shape[-1])
            seen = [self.model.joint_jacobian(self.centre, flat, np.full(len(flat), beam)) for beam in range(beams)]
            felt = np.array(seen).reshape(beams, *poses.shape).swapaxes(0, 1) * cell.repeatability
            noise += np.repeat(np.repeat(felt_alike(felt[:, :, :1]), k, axis=1), k, axis=2) + felt_alike(felt[:, :, 1:])
        return np.linalg.inv(np.linalg.cholesky(noise))
