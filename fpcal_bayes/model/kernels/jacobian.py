"""Compiled kernel: cavity lengths with their derivatives by any parameter of the model vector.

A rotation parameter turns everything behind it about an axis w through a point c, a translation parameter shifts it
along u. With N = n.(o - f), D = n.a and L = N / D (paper equation (24)), turning changes n by w x n and N by
(w x n).(c - f), shifting changes N by n.u, and

    dL = (dN - L dD) / D.

Within a group of poses dN is linear in the prismatic joint values, so the cross products are formed once a group.
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.lengths import (
    ALPHA,
    BETA,
    BETA_ET,
    BETA_WF,
    GAIN,
    RUNOUT_COS,
    RUNOUT_SIN,
    STRIDE,
    THETA,
    THETA_ET,
    THETA_WF,
    X_WF,
    Y_WF,
    Z_ET,
    Z_WF,
    D,
    Question,
    R,
    Turned,
    fill_block,
    optical_axis,
    start_block,
)

# What a parameter does to the mirror plane: a column of the Jacobian.
TURN, SHIFT, TRAVEL, FIBRE, OPTICAL, TURN_GAIN, RUNOUT_AS_COS, RUNOUT_AS_SIN = range(8)


def derivative_columns(revolute: Bools, slots: Ints) -> Ints:
    """What each parameter does, (n, 5): mode, link, axis and point in `chain_axes`, prismatic joints before it."""
    n_links = len(revolute)
    by_extrinsic = {
        BETA_ET: (TURN, n_links, 0, 4),
        THETA_ET: (TURN, n_links, 1, 4),
        BETA_WF: (OPTICAL, 0, 0, 0),
        THETA_WF: (OPTICAL, 0, 1, 0),
        Z_ET: (SHIFT, n_links, 2, 0),
        X_WF: (FIBRE, 0, 0, 0),
        Y_WF: (FIBRE, 0, 1, 0),
        Z_WF: (FIBRE, 0, 2, 0),
    }
    by_link = {BETA: (TURN, 0, 3), ALPHA: (TURN, 1, 3), D: (SHIFT, 1, 0), THETA: (TURN, 2, 4), R: (SHIFT, 2, 0)}
    by_joint = {GAIN: (TURN_GAIN, 2, 4), RUNOUT_COS: (RUNOUT_AS_COS, 2, 0), RUNOUT_SIN: (RUNOUT_AS_SIN, 2, 0)}
    columns = []
    for slot in slots:
        link, kind = divmod(int(slot), STRIDE)
        if link == n_links:
            columns.append((*by_extrinsic[kind], np.count_nonzero(~revolute)))
            continue
        mode, which, point = (by_link | by_joint)[kind]
        if kind in by_joint and not revolute[link]:
            mode = TRAVEL
        columns.append((mode, link, which, point, np.count_nonzero(~revolute[:link])))
    return np.array(columns, dtype=np.int64).reshape(-1, 5)


@compiled
def dot(axes: Floats, link: int, which: int, other_link: int, other: int) -> float:
    """Scalar product of two of the vectors of `chain_axes`."""
    product: float = (
        axes[link, which, 0] * axes[other_link, other, 0]
        + axes[link, which, 1] * axes[other_link, other, 1]
        + axes[link, which, 2] * axes[other_link, other, 2]
    )
    return product


@compiled
def chain_axes(chain: Turned, revolute: Bools, joints: Turned, frame: Floats, axes: Floats) -> None:
    """Axes and points of one group's chain in the world frame, for one model vector, prismatic joints at zero.

    frame: work space, shape (4, 3): X, Y, Z and origin of the frame that has been reached.
    axes: written, shape (n_links + 1, 5, 3). For link i: Y of the frame before it (axis of beta), X after beta (of
    alpha and d), Z (of theta and r), origin before it, origin after d. Last row: X of the tool (axis of beta_et), Y
    after beta_et (of theta_et), Z of the tool (of z_et), mirror normal, mirror origin.
    """
    vector, cosine, sine = chain
    joint_q, joint_cos, joint_sin = joints
    n_links = revolute.size
    first = STRIDE * n_links
    for i in range(3):
        for j in range(4):
            frame[j, i] = 1.0 if i == j else 0.0
    for link in range(n_links):
        at = STRIDE * link
        c_beta, s_beta = cosine[at + BETA], sine[at + BETA]
        c_alpha, s_alpha = cosine[at + ALPHA], sine[at + ALPHA]
        c_theta, s_theta = cosine[at + THETA], sine[at + THETA]
        r = vector[at + R]
        if revolute[link]:
            turned_cos, turned_sin = joint_cos[link], joint_sin[link]
            if vector[at + GAIN] != 0.0:
                turned = joint_q[link] * (1.0 + vector[at + GAIN])
                turned_cos, turned_sin = math.cos(turned), math.sin(turned)
            r += vector[at + RUNOUT_COS] * turned_cos + vector[at + RUNOUT_SIN] * turned_sin
            c_theta, s_theta = c_theta * turned_cos - s_theta * turned_sin, s_theta * turned_cos + c_theta * turned_sin
        for i in range(3):
            x, y, z, origin = frame[0, i], frame[1, i], frame[2, i], frame[3, i]
            new_x = c_beta * x - s_beta * z
            tilted_z = s_beta * x + c_beta * z
            new_y = c_alpha * y + s_alpha * tilted_z
            new_z = c_alpha * tilted_z - s_alpha * y
            moved = origin + vector[at + D] * new_x
            axes[link, 0, i], axes[link, 1, i], axes[link, 2, i] = y, new_x, new_z
            axes[link, 3, i], axes[link, 4, i] = origin, moved
            frame[0, i] = c_theta * new_x + s_theta * new_y
            frame[1, i] = c_theta * new_y - s_theta * new_x
            frame[2, i] = new_z
            frame[3, i] = moved + r * new_z
    c_beta, s_beta = cosine[first + BETA_ET], sine[first + BETA_ET]
    c_theta, s_theta = cosine[first + THETA_ET], sine[first + THETA_ET]
    for i in range(3):
        x, y, z = frame[0, i], frame[1, i], frame[2, i]
        axes[n_links, 0, i] = x
        axes[n_links, 1, i] = c_beta * y + s_beta * z
        axes[n_links, 2, i] = z
        axes[n_links, 3, i] = s_theta * x + c_theta * (c_beta * z - s_beta * y)
        axes[n_links, 4, i] = frame[3, i] + vector[first + Z_ET] * z


@compiled
def slide_axes(vector: Floats, revolute: Bools, axes: Floats, slides: Floats) -> None:
    """Moves of what a prismatic joint carries, per um of its travel; writes `slides` (n_prismatic, 3)."""
    prismatic = 0
    for link in range(revolute.size):
        if not revolute[link]:
            for i in range(3):
                slides[prismatic, i] = axes[link, 2, i] * (1.0 + vector[STRIDE * link + GAIN])
            prismatic += 1


@compiled
def row_changes(starts: Ints, ends: Ints, lengths: Floats, derivatives: Floats, out: Floats, jacobian: Floats) -> None:
    """From poses (n_poses,), (n_poses, n) to rows; writes `out` (n_rows,) and `jacobian` (n_rows, n)."""
    for row in range(ends.size):
        end, start = ends[row], starts[row]
        if start >= 0:
            out[row] = lengths[end] - lengths[start]
            for j in range(derivatives.shape[1]):
                jacobian[row, j] = derivatives[end, j] - derivatives[start, j]
        else:
            out[row] = lengths[end]
            for j in range(derivatives.shape[1]):
                jacobian[row, j] = derivatives[end, j]


@compiled
def optical_axis_moves(cosine: Floats, sine: Floats, first: int, axis_is_z: bool, moves: Floats) -> None:
    """Derivatives of the optical axis by beta_wf and theta_wf; writes `moves` (2, 3)."""
    c_beta, s_beta = cosine[first + BETA_WF], sine[first + BETA_WF]
    c_theta, s_theta = cosine[first + THETA_WF], sine[first + THETA_WF]
    moves[:] = 0.0
    if axis_is_z:
        moves[0, 1], moves[0, 2] = -c_beta, -s_beta
    else:
        moves[0, 1], moves[0, 2] = c_theta * s_beta, -c_theta * c_beta
        moves[1, 0], moves[1, 1], moves[1, 2] = c_theta, s_theta * c_beta, s_theta * s_beta


@compiled
def group_changes(
    columns: Ints, vector: Floats, joint_q: Floats, axes: Floats, beam: Turned, slides: Floats, changes: Floats
) -> None:
    """Derivatives of N, D and the prismatic slopes of one group; writes `changes` (2 + n_prismatic, n_columns)."""
    fibre, optical, axis_moves = beam
    n_links, n_prismatic = axes.shape[0] - 1, slides.shape[0]
    nx, ny, nz = axes[n_links, 3, 0], axes[n_links, 3, 1], axes[n_links, 3, 2]
    for j in range(columns.shape[0]):
        mode, link, which, point, before = columns[j, 0], columns[j, 1], columns[j, 2], columns[j, 3], columns[j, 4]
        for i in range(2 + n_prismatic):
            changes[i, j] = 0.0
        if mode == FIBRE:
            changes[0, j] = -axes[n_links, 3, which]
            continue
        if mode == OPTICAL:
            changes[1, j] = nx * axis_moves[which, 0] + ny * axis_moves[which, 1] + nz * axis_moves[which, 2]
            continue
        ax, ay, az = axes[link, which, 0], axes[link, which, 1], axes[link, which, 2]
        along = nx * ax + ny * ay + nz * az
        if mode == SHIFT:
            changes[0, j] = along
        elif mode == TRAVEL:
            changes[2 + before, j] = along
        if mode in (TURN, TURN_GAIN):
            wx, wy, wz = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
            changes[0, j] = (
                wx * (axes[link, point, 0] - fibre[0])
                + wy * (axes[link, point, 1] - fibre[1])
                + wz * (axes[link, point, 2] - fibre[2])
            )
            changes[1, j] = wx * optical[0] + wy * optical[1] + wz * optical[2]
            for p in range(before):
                changes[2 + p, j] = wx * slides[p, 0] + wy * slides[p, 1] + wz * slides[p, 2]
        if mode >= TURN_GAIN:
            at = STRIDE * link
            turned = joint_q[link] * (1.0 + vector[at + GAIN])
            c, s = math.cos(turned), math.sin(turned)
            if mode == RUNOUT_AS_COS:
                changes[0, j] = c * along
            elif mode == RUNOUT_AS_SIN:
                changes[0, j] = s * along
            else:
                changes[0, j] += (vector[at + RUNOUT_SIN] * c - vector[at + RUNOUT_COS] * s) * along
                for i in range(2 + n_prismatic):
                    changes[i, j] *= joint_q[link]


@compiled
def batch_jacobians(question: Question, columns: Ints) -> tuple[Floats, Floats]:
    """As `batch_lengths`, with derivatives (n_vectors, n_rows, n_columns); `columns` come from `derivative_columns`."""
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
    changes = np.empty((2 + n_prismatic, n_wanted))
    slope, lengths, derivatives = np.empty(n_prismatic), np.empty(n_poses), np.empty((n_poses, n_wanted))
    for k in range(values.shape[0]):
        fill_block(slots, values[k : k + 1], n_links, block_vector, block_cosine, block_sine)
        optical_axis(block_cosine, block_sine, n_links, axis_is_z, block_axis, 1)
        vector[:], cosine[:], sine[:] = block_vector[:, 0], block_cosine[:, 0], block_sine[:, 0]
        optical, fibre = block_axis[:, 0].copy(), vector[first + X_WF : first + Z_WF + 1]
        optical_axis_moves(cosine, sine, first, axis_is_z, axis_moves)
        for g in range(n_groups):
            chain_axes((vector, cosine, sine), revolute, (group_q[g], group_cos[g], group_sin[g]), frame, axes)
            slide_axes(vector, revolute, axes, slides)
            group_changes(columns, vector, group_q[g], axes, (fibre, optical, axis_moves), slides, changes)
            height, facing = dot(axes, n_links, 3, n_links, 4), 0.0
            for i in range(3):
                height -= axes[n_links, 3, i] * fibre[i]
                facing += axes[n_links, 3, i] * optical[i]
            for p in range(n_prismatic):
                slope[p] = 0.0
                for i in range(3):
                    slope[p] += axes[n_links, 3, i] * slides[p, i]
            for m in range(group_start[g], group_start[g + 1]):
                distance = height
                for p in range(n_prismatic):
                    distance += slope[p] * prismatic_q[m, p]
                if path != 0:
                    inverse, length = math.copysign(1.0, distance if path == 1 else path), 0.0
                    lengths[m] = distance * inverse
                else:
                    inverse = 1.0 / facing
                    length = distance * inverse
                    lengths[m] = length
                for j in range(n_wanted):
                    derivatives[m, j] = (changes[0, j] - length * changes[1, j]) * inverse
                for p in range(n_prismatic):
                    q = prismatic_q[m, p] * inverse
                    if q != 0.0:
                        for j in range(n_wanted):
                            derivatives[m, j] += changes[2 + p, j] * q
        row_changes(starts, ends, lengths, derivatives, out[k], jacobian[k])
    return out, jacobian
