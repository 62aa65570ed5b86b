"""Poses laid out for the kernels: those that share every revolute joint value form a group.

Within a group the mirror normal is the same and the cavity length is linear in the prismatic joints, so the kernels
do the trigonometry once a group. The sines of the joint values are data, computed once here.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.model.cell import Cell

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class PoseGroups:
    """Distinct poses, sorted by group.

    Attributes
    ----------
    q
        Distinct joint vectors, shape (n_poses, n_joints), in um and rad.
    group_q, group_cos, group_sin
        Joint values of each group and their cosines and sines, shape (n_groups, n_joints); zero, one, zero at
        prismatic joints.
    group_start
        Poses of group g are ``group_start[g]`` to ``group_start[g + 1]``, shape (n_groups + 1,).
    prismatic_q
        Values of the prismatic joints, in the chain's order, shape (n_poses, n_prismatic).
    inverse
        Where each joint vector that was given stands among the distinct ones, shape (n_given,).
    """

    q: Floats
    group_q: Floats
    group_cos: Floats
    group_sin: Floats
    group_start: Ints
    prismatic_q: Floats
    inverse: Ints

    @property
    def n_groups(self) -> int:
        """Number of distinct revolute joint vectors."""
        return len(self.group_q)


def group_poses(cell: Cell, q: Floats) -> PoseGroups:
    """Lay out joint vectors `q`, shape (n, n_joints) in um and rad, for the kernels."""
    q = np.ascontiguousarray(q, dtype=float)
    if q.ndim != 2 or q.shape[1] != len(cell.joints):
        raise ValueError(f"joint vectors have shape {q.shape}, expected (n, {len(cell.joints)})")
    order = np.concatenate([np.flatnonzero(cell.revolute), np.flatnonzero(~cell.revolute)])
    distinct, inverse = np.unique(q[:, order], axis=0, return_inverse=True)
    distinct = distinct[:, np.argsort(order)]
    revolute_q = np.where(cell.revolute, distinct, 0.0)
    group_q, group_of_pose = np.unique(revolute_q[:, order], axis=0, return_inverse=True)
    group_q = np.ascontiguousarray(group_q[:, np.argsort(order)])
    return PoseGroups(
        q=distinct,
        group_q=group_q,
        group_cos=np.cos(group_q),
        group_sin=np.sin(group_q),
        group_start=np.searchsorted(group_of_pose.reshape(-1), np.arange(len(group_q) + 1)).astype(np.int64),
        prismatic_q=np.ascontiguousarray(distinct[:, ~cell.revolute]),
        inverse=inverse.reshape(-1).astype(np.int64),
    )
