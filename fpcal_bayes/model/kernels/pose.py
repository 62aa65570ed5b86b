"""Compiled kernels: tool pose, its derivatives by the joints, and damped Newton steps towards a pose."""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.jacobian import chain_axes
from fpcal_bayes.model.kernels.lengths import GAIN, RUNOUT_COS, RUNOUT_SIN, STRIDE, Turned, start_block

#: Errors in um and rad at which Newton ends, and within which a pose counts as met.
POSITION_GOAL, ANGLE_GOAL = 1e-9, 1e-13
POSITION_MET, ANGLE_MET = 5e-8, 5e-11
_STEPS = 60

#: Work space: cosines and sines of the joints (n_joints,), and what `chain_axes` writes, `frame` and `axes`.
Work = tuple[Floats, Floats, Floats, Floats]


@compiled
def pose_error(chain: Turned, revolute: Bools, q: Floats, target: Floats, work: Work, error: Floats) -> None:
    """What is missing between the tool frame at `q` and its target wTe, shape (4, 4); prismatic joints are in.

    work: written; the origin of its frame has prismatic joints in.
    error: written, shape (6,): position in um, rotation vector in rad, both in the world frame.
    """
    vector, _, _ = chain
    joint_cos, joint_sin, frame, axes = work
    for link in range(revolute.size):
        joint_cos[link], joint_sin[link] = math.cos(q[link]), math.sin(q[link])
    chain_axes(chain, revolute, (q, joint_cos, joint_sin), frame, axes)
    for link in range(revolute.size):
        if not revolute[link]:
            travel = q[link] * (1.0 + vector[STRIDE * link + GAIN])
            for i in range(3):
                frame[3, i] += travel * axes[link, 2, i]
    trace = 0.0
    for i in range(3):
        error[i] = target[i, 3] - frame[3, i]
        error[3 + i] = 0.0
        for j in range(3):
            trace += frame[j, i] * target[i, j]
    for j in range(3):
        for i in range(3):
            one, two = (i + 1) % 3, (i + 2) % 3
            error[3 + i] += 0.5 * (frame[j, one] * target[two, j] - frame[j, two] * target[one, j])
    size = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
    angle = math.atan2(size, 0.5 * (trace - 1.0))
    if size > 1e-12:
        for i in range(3, 6):
            error[i] *= angle / size
    elif trace < 0.0:
        # Half a turn off: every axis is as good as any other.
        error[3] = math.pi


@compiled
def pose_jacobian(vector: Floats, revolute: Bools, q: Floats, frame: Floats, axes: Floats, jacobian: Floats) -> None:
    """Derivatives of the tool pose by the joints; writes `jacobian` (6, n_joints) from what `pose_error` left."""
    # From the tool to the base: `behind` is what the prismatic joints behind a joint add to its lever arm.
    n_links = revolute.size
    origin_x, origin_y, origin_z = frame[3, 0], frame[3, 1], frame[3, 2]
    for link in range(n_links):
        if not revolute[link]:
            travel = q[link] * (1.0 + vector[STRIDE * link + GAIN])
            origin_x -= travel * axes[link, 2, 0]
            origin_y -= travel * axes[link, 2, 1]
            origin_z -= travel * axes[link, 2, 2]
    for link in range(n_links - 1, -1, -1):
        gain = 1.0 + vector[STRIDE * link + GAIN]
        zx, zy, zz = axes[link, 2, 0], axes[link, 2, 1], axes[link, 2, 2]
        if not revolute[link]:
            jacobian[0, link], jacobian[1, link], jacobian[2, link] = gain * zx, gain * zy, gain * zz
            jacobian[3, link], jacobian[4, link], jacobian[5, link] = 0.0, 0.0, 0.0
            origin_x += q[link] * gain * zx
            origin_y += q[link] * gain * zy
            origin_z += q[link] * gain * zz
            continue
        ax, ay, az = origin_x - axes[link, 4, 0], origin_y - axes[link, 4, 1], origin_z - axes[link, 4, 2]
        turned = q[link] * gain
        at = STRIDE * link
        climb = vector[at + RUNOUT_SIN] * math.cos(turned) - vector[at + RUNOUT_COS] * math.sin(turned)
        jacobian[0, link] = gain * (zy * az - zz * ay + climb * zx)
        jacobian[1, link] = gain * (zz * ax - zx * az + climb * zy)
        jacobian[2, link] = gain * (zx * ay - zy * ax + climb * zz)
        jacobian[3, link], jacobian[4, link], jacobian[5, link] = gain * zx, gain * zy, gain * zz


@compiled
def error_size(error: Floats, length: float) -> float:
    """Sum of squares of a pose error, positions counted in `length`."""
    positions = (error[0] ** 2 + error[1] ** 2 + error[2] ** 2) / length**2
    size: float = positions + error[3] ** 2 + error[4] ** 2 + error[5] ** 2
    return size


@compiled
def within(error: Floats, position: float, angle: float) -> bool:
    """Whether every component of a pose error is within its bound; not a number is not."""
    met = True
    for i in range(3):
        met = met and abs(error[i]) <= position and abs(error[3 + i]) <= angle
    return met


@compiled
def newton(chain: Turned, revolute: Bools, length: float, target: Floats, q: Floats, work: Work, error: Floats) -> bool:
    """Damped Newton steps from `q`, which is overwritten; whether the pose is met."""
    vector, _, _ = chain
    _, _, frame, axes = work
    n = revolute.size
    jacobian = np.empty((6, n))
    pose_error(chain, revolute, q, target, work, error)
    if within(error, POSITION_GOAL, ANGLE_GOAL):
        return True
    trial, step, normal = np.empty(n), np.empty(n), np.empty((n, n))
    size, damping = error_size(error, length), 1e-3
    for _ in range(_STEPS):
        if within(error, POSITION_GOAL, ANGLE_GOAL) or damping > 1e8:
            break
        pose_jacobian(vector, revolute, q, frame, axes, jacobian)
        for j in range(n):
            for i in range(6):
                jacobian[i, j] *= (1.0 if revolute[j] else length) / (length if i < 3 else 1.0)
        improved = False
        while not improved and damping <= 1e8:
            for i in range(n):
                step[i] = 0.0
                for k in range(6):
                    step[i] += jacobian[k, i] * error[k] / (length if k < 3 else 1.0)
                for j in range(n):
                    normal[i, j] = damping if i == j else 0.0
                    for k in range(6):
                        normal[i, j] += jacobian[k, i] * jacobian[k, j]
            if np.isfinite(normal).all() and np.isfinite(step).all():
                step = np.linalg.solve(normal, step)
                largest = 0.0
                for i in range(n):
                    largest = max(largest, abs(step[i]) if revolute[i] else 0.0)
                short = min(1.0, 1.0 / largest) if largest > 0.0 else 1.0
                for i in range(n):
                    trial[i] = q[i] + short * step[i] * (1.0 if revolute[i] else length)
                pose_error(chain, revolute, trial, target, work, error)
                smaller = error_size(error, length)
                improved = smaller < size
            if improved:
                size, damping = smaller, damping * 1e-3
                q[:] = trial
            else:
                damping = max(damping, 1e-12) * 10.0
                pose_error(chain, revolute, q, target, work, error)
                # What rounding leaves cannot be improved upon.
                if within(error, POSITION_MET, ANGLE_MET):
                    return True
    return within(error, POSITION_MET, ANGLE_MET)


@compiled
def batch_tool_poses(vectors: Floats, revolute: Bools, q: Floats) -> Floats:
    """Tool frames wTe, paper (12), (n_vectors, n_poses, 4, 4), at joints `q` of each vector, or one set for all."""
    n, n_vectors, n_poses = revolute.size, vectors.shape[0], q.shape[1]
    poses = np.zeros((n_vectors, n_poses, 4, 4))
    joint_cos, joint_sin = np.empty(n), np.empty(n)
    frame, error, origin = np.empty((4, 3)), np.empty(6), np.eye(4)
    work = joint_cos, joint_sin, frame, np.empty((n + 1, 5, 3))
    for k in range(n_vectors):
        _, block_cosine, block_sine = start_block(vectors[k], n, 1, 1)
        chain = vectors[k], block_cosine[:, 0].copy(), block_sine[:, 0].copy()
        for m in range(n_poses):
            pose_error(chain, revolute, q[k if q.shape[0] > 1 else 0, m], origin, work, error)
            for i in range(3):
                for j in range(4):
                    poses[k, m, i, j] = frame[j, i]
            poses[k, m, 3, 3] = 1.0
    return poses
