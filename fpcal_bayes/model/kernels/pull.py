"""Compiled kernel: how the joints change the derivative of the cavity length along a direction of the parameters.

With N = n.(o - f), D = n.a and L = N / D (see `jacobian`) a joint about the axis z through c turns n by m = z x n, and
with it the axes of the parameters behind it. What these make of n adds up to W; what those before it make of N and D is
n.U and n.V. So the joint changes the derivative of N by m.U + (z x W).(c - f) and that of D by m.V + (z x W).a. A joint
that travels changes that of N by z.W.
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.jacobian import FIBRE, OPTICAL, SHIFT, chain_axes, optical_axis_moves
from fpcal_bayes.model.kernels.lengths import STRIDE, X_WF, Z_WF, Question, R, fill_block, optical_axis, start_block


@compiled
def cross(axes: Floats, link: int, which: int, other: Floats, scale: float, total: Floats, place: int) -> None:
    """Add the vector product of one of `chain_axes` and another vector, times `scale`, to ``total[place]``."""
    x, y, z = axes[link, which, 0], axes[link, which, 1], axes[link, which, 2]
    total[place, 0] += scale * (y * other[2] - z * other[1])
    total[place, 1] += scale * (z * other[0] - x * other[2])
    total[place, 2] += scale * (x * other[1] - y * other[0])


@compiled
def joint_pulls(question: Question, columns: Ints, pulls: Floats) -> Floats:
    """Derivatives by the joints of those of the length at poses along `pulls` (n_vectors, n_poses, n_columns).

    `columns` come from `derivative_columns`, without gains and runouts. Summed over vectors, (n_poses, n_joints).
    """
    base, slots, values, path, axis_is_z, revolute, groups, _, ends = question
    group_q, group_cos, group_sin, group_start, prismatic_q = groups
    n_links, n_columns = revolute.size, columns.shape[0]
    first, result = STRIDE * n_links, np.zeros((ends.size, n_links))
    block_vector, block_cosine, block_sine = start_block(base, n_links, 1, 1)
    vector, cosine, sine = np.empty(base.size), np.empty(base.size), np.empty(base.size)
    frame, axes, block_axis = np.empty((4, 3)), np.empty((n_links + 1, 5, 3)), np.empty((3, 1))
    moves, normal, arm, behind = np.empty((2, 3)), np.empty(3), np.empty(3), np.empty(3)
    # What the parameters of each link pull at in N and D, and what they make of n; then of the joint alone.
    by_n, by_d = np.empty((n_links + 1, 3)), np.empty((n_links + 1, 3))
    turned, own = np.empty((n_links + 1, 3)), np.empty((2, 3))
    for k in range(values.shape[0]):
        fill_block(slots, values[k : k + 1], n_links, block_vector, block_cosine, block_sine)
        optical_axis(block_cosine, block_sine, n_links, axis_is_z, block_axis, 1)
        vector[:], cosine[:], sine[:] = block_vector[:, 0], block_cosine[:, 0], block_sine[:, 0]
        optical, fibre = block_axis[:, 0].copy(), vector[first + X_WF : first + Z_WF + 1].copy()
        optical_axis_moves(cosine, sine, first, axis_is_z, moves)
        for p in range(ends.size):
            g, prismatic = np.searchsorted(group_start, ends[p], side="right") - 1, 0
            for link in range(n_links):
                if not revolute[link]:
                    vector[STRIDE * link + R] = block_vector[STRIDE * link + R, 0] + prismatic_q[ends[p], prismatic]
                    prismatic += 1
            chain_axes((vector, cosine, sine), revolute, (group_q[g], group_cos[g], group_sin[g]), frame, axes)
            by_n[:], by_d[:], turned[:], behind[:] = 0.0, 0.0, 0.0, 0.0
            height = facing = along_n = along_d = 0.0
            for i in range(3):
                normal[i] = axes[n_links, 3, i]
                height += normal[i] * (axes[n_links, 4, i] - fibre[i])
                facing += normal[i] * optical[i]
            for c in range(n_columns):
                pull, mode, link, which = pulls[k, p, c], columns[c, 0], columns[c, 1], columns[c, 2]
                if mode == FIBRE:
                    by_n[0, which] -= pull
                elif mode == OPTICAL:
                    for i in range(3):
                        by_d[0, i] += pull * moves[which, i]
                elif mode == SHIFT:
                    for i in range(3):
                        by_n[link, i] += pull * axes[link, which, i]
                else:
                    for i in range(3):
                        arm[i] = axes[link, columns[c, 3], i] - fibre[i]
                    cross(axes, link, which, arm, -pull, by_n, link)
                    cross(axes, link, which, optical, -pull, by_d, link)
                    cross(axes, link, which, normal, pull, turned, link)
            for link in range(n_links + 1):
                for i in range(3):
                    along_n += normal[i] * by_n[link, i]
                    along_d += normal[i] * by_d[link, i]
                    behind[i] += turned[link, i]
                    if link:
                        by_n[link, i] += by_n[link - 1, i]
                        by_d[link, i] += by_d[link - 1, i]
            along = (along_n - height / facing * along_d) / facing
            for j in range(n_links):
                pulled_n = pulled_d = own_n = own_d = 0.0
                for i in range(3):
                    behind[i] -= turned[j, i]
                if revolute[j]:
                    own[:] = 0.0
                    cross(axes, j, 2, normal, 1.0, own, 0)
                    cross(axes, j, 2, behind, 1.0, own, 1)
                    for i in range(3):
                        lever = axes[j, 4, i] - fibre[i]
                        own_n += own[0, i] * lever
                        own_d += own[0, i] * optical[i]
                        pulled_n += own[0, i] * by_n[j, i] + own[1, i] * lever
                        pulled_d += own[0, i] * by_d[j, i] + own[1, i] * optical[i]
                else:
                    for i in range(3):
                        own_n += normal[i] * axes[j, 2, i]
                        pulled_n += behind[i] * axes[j, 2, i]
                if path != 0:
                    result[p, j] += pulled_n * math.copysign(1.0, height if path == 1 else path)
                else:
                    by_length = (own_n - height / facing * own_d) / facing
                    changed = pulled_n - by_length * along_d - height / facing * pulled_d - along * own_d
                    result[p, j] += changed / facing
    return result
