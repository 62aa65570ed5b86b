"""Compiled kernels: cavity lengths for many parameter vectors and poses at once.

A mirror plane {x : n.x = h} is carried from the tool to the base: four numbers a pose instead of a 4x4 transform.
For one model vector, poses that share all revolute joint values (a group, see `fpcal_bayes.model.cavity`) share n, and

    h = h0 + sum_p slope_p q_p,    slope_p = n . z_p,

is linear in the prismatic joint values q_p; slope_p is the Z component of n in the frame of link p. With fibre end f
and optical axis a the paper's (24) reads L = (h - n.f) / (n.a).
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled

# Positions in the eight numbers of a link, and of the extrinsics behind the last link.
BETA, ALPHA, D, THETA, R, GAIN, RUNOUT_COS, RUNOUT_SIN = range(8)
STRIDE = 8
BETA_ET, THETA_ET, BETA_WF, THETA_WF, Z_ET, X_WF, Y_WF, Z_WF = range(8)

#: Parameter vectors computed side by side, so that one instruction serves several of them.
LANES = 64

#: Model vectors, their cosines and sines; or joint values, their cosines and sines.
Turned = tuple[Floats, Floats, Floats]
#: Values, cosines and sines of the joints of each group, (n_groups, n_joints), where the poses of each begin,
#: (n_groups + 1,), and the prismatic joints, (n_poses, n_prismatic); see `fpcal_bayes.model.cavity.PoseGroups`.
Groups = tuple[Floats, Floats, Floats, Ints, Floats]
#: What the kernels of lengths and derivatives are asked: the model vector of what is held; places of the free
#: parameters in it, (n,), and their values, (n_vectors, n); the path, 0 along the axis, 1 the perpendicular distance, 2
#: or -2 that with a sign, on the side where it is positive; whether Zf is the optical axis; which joints turn; the
#: poses; and the poses where each row starts and ends, a start of -1 standing for the length at the end itself.
Question = tuple[Floats, Ints, Floats, int, bool, Bools, Groups, Ints, Ints]


@compiled
def is_angle(slot: int, n_links: int) -> bool:
    """Whether the entry `slot` of the model vector is an angle whose sine the model needs."""
    if slot < STRIDE * n_links:
        return (slot % STRIDE) in (BETA, ALPHA, THETA)
    return slot - STRIDE * n_links <= THETA_WF


@compiled
def start_block(base: Floats, n_links: int, n_lanes: int, width: int) -> Turned:
    """Model vectors of a block of equal lanes, with cosines and sines, shape (model size, width) each."""
    vector, cosine, sine = np.empty((base.size, width)), np.empty((base.size, width)), np.empty((base.size, width))
    for slot in range(base.size):
        c, s = 1.0, 0.0
        if is_angle(slot, n_links):
            c, s = math.cos(base[slot]), math.sin(base[slot])
        for lane in range(n_lanes):
            vector[slot, lane], cosine[slot, lane], sine[slot, lane] = base[slot], c, s
    return vector, cosine, sine


@compiled
def fill_block(slots: Ints, values: Floats, n_links: int, vector: Floats, cosine: Floats, sine: Floats) -> None:
    """Put parameter vectors `values` (n_lanes, n) into the model vectors of a block, with cosines and sines."""
    for j in range(slots.size):
        slot = slots[j]
        for lane in range(values.shape[0]):
            vector[slot, lane] = values[lane, j]
        if is_angle(slot, n_links):
            for lane in range(values.shape[0]):
                cosine[slot, lane] = math.cos(values[lane, j])
                sine[slot, lane] = math.sin(values[lane, j])


@compiled
def optical_axis(cosine: Floats, sine: Floats, n_links: int, axis_is_z: bool, axis: Floats, n_lanes: int) -> None:
    """Direction of the light that leaves the fibre, in the world frame; writes `axis` (3, at least n_lanes)."""
    first = STRIDE * n_links
    c_beta, s_beta = cosine[first + BETA_WF], sine[first + BETA_WF]
    c_theta, s_theta = cosine[first + THETA_WF], sine[first + THETA_WF]
    for lane in range(n_lanes):
        if axis_is_z:
            axis[0, lane], axis[1, lane], axis[2, lane] = 0.0, -s_beta[lane], c_beta[lane]
        else:
            axis[0, lane] = s_theta[lane]
            axis[1, lane] = -c_theta[lane] * c_beta[lane]
            axis[2, lane] = -c_theta[lane] * s_beta[lane]


@compiled
def turn_mirror(link: Floats, q: float, plane: Floats, n_lanes: int) -> None:
    """What a joint's gain and axial runout add to its turn by `q`, for a block; `link` has shape (8, LANES)."""
    for lane in range(n_lanes):
        turned, extra = q * (1.0 + link[GAIN, lane]), q * link[GAIN, lane]
        c, s = math.cos(extra), math.sin(extra)
        x, y = plane[0, lane], plane[1, lane]
        plane[0, lane], plane[1, lane] = c * x - s * y, s * x + c * y
        runout = link[RUNOUT_COS, lane] * math.cos(turned) + link[RUNOUT_SIN, lane] * math.sin(turned)
        plane[3, lane] += plane[2, lane] * runout


@compiled
def carry_plane(
    block: Turned, revolute: Bools, used: Bools, joints: Turned, plane: Floats, slope: Floats, n_lanes: int
) -> None:
    """Carry the mirror plane of one group to the world frame, prismatic joints at zero, for a block of LANES vectors.

    used: whether an entry of the model vector may differ from zero in some lane, shape (model size,).
    plane, slope: written: n and h, shape (4, LANES); slope of h in each prismatic joint, shape (n_prismatic, LANES).
    """
    vector, cosine, sine = block
    joint_q, joint_cos, joint_sin = joints
    n_links = revolute.size
    first = STRIDE * n_links
    # Flat views whose rows stand LANES apart: the compiler sees that rows do not overlap, and computes lanes together.
    values, cosines, sines, carried = vector.reshape(-1), cosine.reshape(-1), sine.reshape(-1), plane.reshape(-1)
    x_row, y_row, z_row, h_row = 0, LANES, 2 * LANES, 3 * LANES
    cos, sin, value = cosines[first * LANES :], sines[first * LANES :], values[first * LANES :]
    for lane in range(n_lanes):
        c_theta, z = cos[THETA_ET * LANES + lane], cos[THETA_ET * LANES + lane] * cos[BETA_ET * LANES + lane]
        carried[x_row + lane] = sin[THETA_ET * LANES + lane]
        carried[y_row + lane] = -c_theta * sin[BETA_ET * LANES + lane]
        carried[z_row + lane] = z
        carried[h_row + lane] = z * value[Z_ET * LANES + lane]
    prismatic = slope.shape[0]
    for link in range(n_links - 1, -1, -1):
        at = STRIDE * link
        if not revolute[link]:
            prismatic -= 1
            gain, out, nz = vector[at + GAIN], slope[prismatic], plane[2]
            for lane in range(n_lanes):
                out[lane] = nz[lane] * (1.0 + gain[lane])
        elif used[at + GAIN] or used[at + RUNOUT_COS] or used[at + RUNOUT_SIN]:
            turn_mirror(vector[at : at + STRIDE], joint_q[link], plane, n_lanes)
        cos, sin, value = cosines[at * LANES :], sines[at * LANES :], values[at * LANES :]
        q_cos, q_sin = joint_cos[link], joint_sin[link]
        for lane in range(n_lanes):
            x, y = carried[x_row + lane], carried[y_row + lane]
            z, h = carried[z_row + lane], carried[h_row + lane]
            # The sine of a sum: the joint value's own sine is data.
            c = cos[THETA * LANES + lane] * q_cos - sin[THETA * LANES + lane] * q_sin
            s = sin[THETA * LANES + lane] * q_cos + cos[THETA * LANES + lane] * q_sin
            turned_x = c * x - s * y
            turned_y = s * x + c * y
            c, s = cos[ALPHA * LANES + lane], sin[ALPHA * LANES + lane]
            tilted_z = s * turned_y + c * z
            carried[h_row + lane] = h + z * value[R * LANES + lane] + turned_x * value[D * LANES + lane]
            carried[y_row + lane] = c * turned_y - s * z
            c, s = cos[BETA * LANES + lane], sin[BETA * LANES + lane]
            carried[x_row + lane] = c * turned_x + s * tilted_z
            carried[z_row + lane] = c * tilted_z - s * turned_x


@compiled
def batch_lengths(question: Question) -> Floats:
    """Changes of cavity length, L(end) - L(start), for many parameter vectors, shape (n_vectors, n_rows), in um."""
    base, slots, values, path, axis_is_z, revolute, groups, starts, ends = question
    group_q, group_cos, group_sin, group_start, prismatic_q = groups
    n_links, n_vectors, n_rows = revolute.size, values.shape[0], ends.size
    n_groups, n_poses, n_prismatic = group_q.shape[0], prismatic_q.shape[0], prismatic_q.shape[1]
    n_lanes = max(1, min(n_vectors, LANES))
    first = STRIDE * n_links
    out = np.empty((n_vectors, n_rows))
    whole = start_block(base, n_links, n_lanes, LANES)
    vector, cosine, sine = whole
    used = base != 0.0
    for j in range(slots.size):
        used[slots[j]] = True
    plane, slope, axis = np.empty((4, LANES)), np.empty((n_prismatic, LANES)), np.empty((3, LANES))
    lengths, inverse = np.empty((n_poses, n_lanes)), np.ones(n_lanes)
    x, y, z = vector[first + X_WF], vector[first + Y_WF], vector[first + Z_WF]
    for block in range(0, n_vectors, n_lanes):
        here = min(n_lanes, n_vectors - block)
        fill_block(slots, values[block : block + here], n_links, vector, cosine, sine)
        optical_axis(cosine, sine, n_links, axis_is_z, axis, n_lanes)
        for g in range(n_groups):
            carry_plane(whole, revolute, used, (group_q[g], group_cos[g], group_sin[g]), plane, slope, n_lanes)
            nx, ny, nz, height = plane[0], plane[1], plane[2], plane[3]
            for lane in range(n_lanes):
                height[lane] -= nx[lane] * x[lane] + ny[lane] * y[lane] + nz[lane] * z[lane]
            if path == 0:
                for lane in range(n_lanes):
                    facing = nx[lane] * axis[0, lane] + ny[lane] * axis[1, lane] + nz[lane] * axis[2, lane]
                    inverse[lane] = 1.0 / facing
                    height[lane] *= inverse[lane]
                for p in range(n_prismatic):
                    for lane in range(n_lanes):
                        slope[p, lane] *= inverse[lane]
            for m in range(group_start[g], group_start[g + 1]):
                length = lengths[m]
                if n_prismatic == 3:
                    q0, q1, q2 = prismatic_q[m, 0], prismatic_q[m, 1], prismatic_q[m, 2]
                    for lane in range(n_lanes):
                        length[lane] = height[lane] + q0 * slope[0, lane] + q1 * slope[1, lane] + q2 * slope[2, lane]
                else:
                    for lane in range(n_lanes):
                        length[lane] = height[lane]
                    for p in range(n_prismatic):
                        for lane in range(n_lanes):
                            length[lane] += prismatic_q[m, p] * slope[p, lane]
                if path == 1 or path == -2:
                    for lane in range(n_lanes):
                        length[lane] = abs(length[lane]) if path == 1 else -length[lane]
        for lane in range(here):
            for row in range(n_rows):
                change = lengths[ends[row], lane]
                if starts[row] >= 0:
                    change -= lengths[starts[row], lane]
                out[block + lane, row] = change
    return out


@compiled
def few_vector_lengths(question: Question) -> Floats:
    """The same as `batch_lengths` with groups side by side in place of vectors; without gains and runouts."""
    base, slots, values, path, axis_is_z, revolute, groups, starts, ends = question
    group_q, group_cos, group_sin, group_start, prismatic_q = groups
    n_links, n_vectors, n_rows = revolute.size, values.shape[0], ends.size
    n_groups, n_prismatic = group_q.shape[0], prismatic_q.shape[1]
    first = STRIDE * n_links
    out, used = np.empty((n_vectors, n_rows)), np.zeros(base.size, dtype=np.bool_)
    plane, slope, axis = np.empty((4, LANES)), np.empty((n_prismatic, LANES)), np.empty((3, LANES))
    lengths, still = np.empty(prismatic_q.shape[0]), (np.zeros(n_links), np.ones(n_links), np.zeros(n_links))
    for v in range(n_vectors):
        whole = base.copy()
        for j in range(slots.size):
            whole[slots[j]] = values[v, j]
        lanes = start_block(whole, n_links, LANES, LANES)
        _, cosine, sine = lanes
        optical_axis(cosine, sine, n_links, axis_is_z, axis, LANES)
        turned_cos, turned_sin = cosine[:, 0].copy(), sine[:, 0].copy()
        for block in range(0, n_groups, LANES):
            here = min(LANES, n_groups - block)
            for link in range(n_links):
                if revolute[link]:
                    at = STRIDE * link + THETA
                    c, s = turned_cos[at], turned_sin[at]
                    for lane in range(here):
                        q_cos, q_sin = group_cos[block + lane, link], group_sin[block + lane, link]
                        cosine[at, lane], sine[at, lane] = c * q_cos - s * q_sin, s * q_cos + c * q_sin
            carry_plane(lanes, revolute, used, still, plane, slope, LANES)
            for lane in range(here):
                nx, ny, nz = plane[0, lane], plane[1, lane], plane[2, lane]
                height = plane[3, lane] - nx * whole[first + X_WF] - ny * whole[first + Y_WF] - nz * whole[first + Z_WF]
                inverse = 1.0
                if path == 0:
                    inverse = 1.0 / (nx * axis[0, lane] + ny * axis[1, lane] + nz * axis[2, lane])
                for m in range(group_start[block + lane], group_start[block + lane + 1]):
                    length = height
                    for p in range(n_prismatic):
                        length += prismatic_q[m, p] * slope[p, lane]
                    length *= inverse
                    if path == 1 or path == -2:
                        length = abs(length) if path == 1 else -length
                    lengths[m] = length
        for row in range(n_rows):
            out[v, row] = lengths[ends[row]] - (lengths[starts[row]] if starts[row] >= 0 else 0.0)
    return out


@compiled
def batch_mirrors(base: Floats, slots: Ints, values: Floats, revolute: Bools, q: Floats) -> tuple[Floats, Floats]:
    """Mirror normals and origins, columns three and four of wTt (paper equation (19)), (n_vectors, n_poses, 3) each."""
    n_links, n_poses = revolute.size, q.shape[0]
    first = STRIDE * n_links
    normals, origins = np.empty((values.shape[0], n_poses, 3)), np.empty((values.shape[0], n_poses, 3))
    block, block_cosine, block_sine = start_block(base, n_links, 1, 1)
    joint_cos, joint_sin = np.cos(q), np.sin(q)
    for k in range(values.shape[0]):
        fill_block(slots, values[k : k + 1], n_links, block, block_cosine, block_sine)
        vector, cosine, sine = block[:, 0], block_cosine[:, 0], block_sine[:, 0]
        for m in range(n_poses):
            nx = sine[first + THETA_ET]
            ny = -cosine[first + THETA_ET] * sine[first + BETA_ET]
            nz = cosine[first + THETA_ET] * cosine[first + BETA_ET]
            ox, oy, oz = 0.0, 0.0, vector[first + Z_ET]
            for link in range(n_links - 1, -1, -1):
                at = STRIDE * link
                c, s = cosine[at + THETA], sine[at + THETA]
                oz += vector[at + R]
                if revolute[link]:
                    turned_cos, turned_sin = joint_cos[m, link], joint_sin[m, link]
                    if vector[at + GAIN] != 0.0:
                        turned = q[m, link] * (1.0 + vector[at + GAIN])
                        turned_cos, turned_sin = math.cos(turned), math.sin(turned)
                    oz += vector[at + RUNOUT_COS] * turned_cos + vector[at + RUNOUT_SIN] * turned_sin
                    c, s = c * turned_cos - s * turned_sin, s * turned_cos + c * turned_sin
                else:
                    oz += q[m, link] * (1.0 + vector[at + GAIN])
                nx, ny = c * nx - s * ny, s * nx + c * ny
                ox, oy = c * ox - s * oy + vector[at + D], s * ox + c * oy
                c, s = cosine[at + ALPHA], sine[at + ALPHA]
                ny, nz = c * ny - s * nz, s * ny + c * nz
                oy, oz = c * oy - s * oz, s * oy + c * oz
                c, s = cosine[at + BETA], sine[at + BETA]
                nx, nz = c * nx + s * nz, c * nz - s * nx
                ox, oz = c * ox + s * oz, c * oz - s * ox
            normals[k, m, 0], normals[k, m, 1], normals[k, m, 2] = nx, ny, nz
            origins[k, m, 0], origins[k, m, 1], origins[k, m, 2] = ox, oy, oz
    return normals, origins
