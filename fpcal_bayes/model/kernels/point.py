"""Compiled kernels: lengths to a point of the tool frame, along a fixed beam or along one that follows it.

With the point p, the beam's end f and its direction a

    L = a.(p - f)    (a fixed beam),        L = |p - f|    (a beam that follows),        dL = u.(dp - df) + da.(p - f),

u being a or the unit vector from f to p. Turning about an axis w through c moves p by w x (p - c).
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.jacobian import (
    FIBRE,
    OPTICAL,
    RUNOUT_AS_COS,
    RUNOUT_AS_SIN,
    SHIFT,
    TRAVEL,
    TURN,
    TURN_GAIN,
    chain_axes,
    derivative_columns,
    optical_axis_moves,
    row_changes,
    slide_axes,
)
from fpcal_bayes.model.kernels.lengths import (
    GAIN,
    RUNOUT_COS,
    RUNOUT_SIN,
    STRIDE,
    X_WF,
    Z_WF,
    Question,
    fill_block,
    optical_axis,
    start_block,
)

#: Where the point stands in the tool frame: positions in the extrinsics.
X_ET, Y_ET, Z_ET = 0, 1, 4


def point_columns(revolute: Bools, slots: Ints) -> Ints:
    """As `derivative_columns`, with shifts along the tool's axes where a mirror has its angles."""
    columns = derivative_columns(revolute, slots)
    for column, slot in zip(columns, slots, strict=True):
        place = int(slot) - STRIDE * len(revolute)
        if place in (X_ET, Y_ET):
            column[:] = SHIFT, len(revolute), place, 0, np.count_nonzero(~revolute)
    return columns


@compiled
def batch_points(question: Question, columns: Ints) -> tuple[Floats, Floats]:
    """As `batch_jacobians`, of the length to a point; `columns`, which may be none, come from `point_columns`.

    The path is 0 for a fixed beam, else the beam follows.
    """
    base, slots, values, path, axis_is_z, revolute, groups, starts, ends = question
    group_q, group_cos, group_sin, group_start, prismatic_q = groups
    n_links, n_rows, n_wanted = revolute.size, ends.size, columns.shape[0]
    n_groups, n_poses, n_prismatic = group_q.shape[0], prismatic_q.shape[0], prismatic_q.shape[1]
    first = STRIDE * n_links
    out, jacobian = np.empty((values.shape[0], n_rows)), np.empty((values.shape[0], n_rows, n_wanted))
    block_vector, block_cosine, block_sine = start_block(base, n_links, 1, 1)
    vector, cosine, sine = np.empty(base.size), np.empty(base.size), np.empty(base.size)
    frame, axes = np.empty((4, 3)), np.empty((n_links + 1, 5, 3))
    block_axis, axis_moves, slides = np.empty((3, 1)), np.empty((2, 3)), np.empty((n_prismatic, 3))
    along, point, away, arm = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    lengths, derivatives = np.empty(n_poses), np.empty((n_poses, n_wanted))
    for k in range(values.shape[0]):
        fill_block(slots, values[k : k + 1], n_links, block_vector, block_cosine, block_sine)
        optical_axis(block_cosine, block_sine, n_links, axis_is_z, block_axis, 1)
        vector[:], cosine[:], sine[:] = block_vector[:, 0], block_cosine[:, 0], block_sine[:, 0]
        fibre = vector[first + X_WF : first + Z_WF + 1]
        optical_axis_moves(cosine, sine, first, axis_is_z, axis_moves)
        for g in range(n_groups):
            chain_axes((vector, cosine, sine), revolute, (group_q[g], group_cos[g], group_sin[g]), frame, axes)
            slide_axes(vector, revolute, axes, slides)
            for m in range(group_start[g], group_start[g + 1]):
                for i in range(3):
                    point[i] = frame[3, i] + vector[first + X_ET] * frame[0, i] + vector[first + Y_ET] * frame[1, i]
                    point[i] += vector[first + Z_ET] * frame[2, i]
                    for p in range(n_prismatic):
                        point[i] += prismatic_q[m, p] * slides[p, i]
                    away[i] = point[i] - fibre[i]
                size = math.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
                lengths[m] = size
                for i in range(3):
                    along[i] = block_axis[i, 0] if path == 0 else away[i] / size
                if path == 0:
                    lengths[m] = along[0] * away[0] + along[1] * away[1] + along[2] * away[2]
                for j in range(n_wanted):
                    mode, link, which, centre, before = columns[j]
                    change = 0.0
                    if mode == FIBRE:
                        change = -along[which]
                    elif mode == OPTICAL:
                        if path == 0:
                            for i in range(3):
                                change += axis_moves[which, i] * away[i]
                    else:
                        ax, ay, az = axes[link, which, 0], axes[link, which, 1], axes[link, which, 2]
                        if link == n_links:
                            ax, ay, az = frame[which, 0], frame[which, 1], frame[which, 2]
                        straight = along[0] * ax + along[1] * ay + along[2] * az
                        if mode in (TURN, TURN_GAIN):
                            for i in range(3):
                                arm[i] = point[i] - axes[link, centre, i]
                                for p in range(before):
                                    arm[i] -= prismatic_q[m, p] * slides[p, i]
                            change = along[0] * (ay * arm[2] - az * arm[1])
                            change += along[1] * (az * arm[0] - ax * arm[2])
                            change += along[2] * (ax * arm[1] - ay * arm[0])
                        elif mode == SHIFT:
                            change = straight
                        elif mode == TRAVEL:
                            change = straight * prismatic_q[m, before]
                        if mode >= TURN_GAIN:
                            at = STRIDE * link
                            turned = group_q[g, link] * (1.0 + vector[at + GAIN])
                            c, s = math.cos(turned), math.sin(turned)
                            if mode == RUNOUT_AS_COS:
                                change = c * straight
                            elif mode == RUNOUT_AS_SIN:
                                change = s * straight
                            else:
                                change += (vector[at + RUNOUT_SIN] * c - vector[at + RUNOUT_COS] * s) * straight
                                change *= group_q[g, link]
                    derivatives[m, j] = change
        row_changes(starts, ends, lengths, derivatives, out[k], jacobian[k])
    return out, jacobian
