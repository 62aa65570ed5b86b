"""Compiled kernels: the closed form of chains with three revolute and three prismatic joints, in any order.

Prismatic joints never turn anything, so the three turns alone give the orientation. With the target's orientation
M = Rz(p1) A2 Rz(p2) A3 Rz(p3), A2 and A3 being constant rotations of the chain,

    M[2, 2] = P cos p2 + Q sin p2 + K

has two solutions p2 (the generalised Euler angles of Davenport, see Wittenburg and Lilov, Multibody System Dynamics 9,
2003), p1 and p3 follow from the third column and the third row of M, and the position is linear in the prismatic
joints.
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.lengths import ALPHA, BETA, GAIN, STRIDE, THETA

#: How far |cos p2| may pass 1 by rounding.
_COSINE_SLACK = 1e-9
_TURN = 2.0 * math.pi


@compiled
def constant_rotations(cosine: Floats, sine: Floats, revolute: Bools, between: Floats) -> None:
    """Rotations before, between and behind the revolute joints; writes `between` (n_revolute + 1, 3, 3)."""
    part, x = 0, between[0]
    x[:] = np.eye(3)
    for link in range(revolute.size):
        at = STRIDE * link
        cb, sb, ca, sa = cosine[at + BETA], sine[at + BETA], cosine[at + ALPHA], sine[at + ALPHA]
        ct, st = cosine[at + THETA], sine[at + THETA]
        for i in range(3):
            first = cb * x[i, 0] - sb * x[i, 2]
            tilted = sb * x[i, 0] + cb * x[i, 2]
            second, third = ca * x[i, 1] + sa * tilted, ca * tilted - sa * x[i, 1]
            x[i, 0], x[i, 1], x[i, 2] = ct * first + st * second, ct * second - st * first, third
        if revolute[link]:
            part += 1
            x = between[part]
            x[:] = np.eye(3)


@compiled
def three_turns(between: Floats, target: Floats, turns: Floats) -> int:
    """Turns of three revolute joints that give the orientation of `target`, wTe; `between` by `constant_rotations`.

    Writes `turns` (2, 3), in rad, equal where the two solutions meet. Returns 2, or 0 if it is out of reach.
    """
    m, half_way = np.empty((3, 3)), np.empty((3, 3))
    first, last = between[0], between[3]
    for i in range(3):
        for j in range(3):
            half_way[i, j] = first[0, i] * target[0, j] + first[1, i] * target[1, j] + first[2, i] * target[2, j]
    for i in range(3):
        for j in range(3):
            m[i, j] = half_way[i, 0] * last[j, 0] + half_way[i, 1] * last[j, 1] + half_way[i, 2] * last[j, 2]
    a, b = between[1], between[2]
    p = a[2, 0] * b[0, 2] + a[2, 1] * b[1, 2]
    q = a[2, 1] * b[0, 2] - a[2, 0] * b[1, 2]
    wanted, size = m[2, 2] - a[2, 2] * b[2, 2], math.hypot(p, q)
    if not abs(wanted) <= size + _COSINE_SLACK:
        return 0
    ratio = max(-1.0, min(1.0, wanted / size)) if size > 0.0 else 1.0
    middle, half = math.atan2(q, p), math.acos(ratio)
    product = np.empty((3, 3))
    for branch in range(2):
        turn = middle + (half if branch == 0 else -half)
        c, s = math.cos(turn), math.sin(turn)
        for i in range(3):
            x, y = a[i, 0] * c + a[i, 1] * s, a[i, 1] * c - a[i, 0] * s
            for j in range(3):
                product[i, j] = x * b[0, j] + y * b[1, j] + a[i, 2] * b[2, j]
        turns[branch, 0] = math.atan2(m[1, 2], m[0, 2]) - math.atan2(product[1, 2], product[0, 2])
        turns[branch, 1] = turn
        turns[branch, 2] = math.atan2(product[2, 1], product[2, 0]) - math.atan2(m[2, 1], m[2, 0])
    return 2


@compiled
def wind(q: float, period: float, near: float, low: float, high: float) -> float:
    """The joint value whole periods from `q` that lies nearest to `near`, inside the limits if one does."""
    slack = 1e-9 * (1.0 + abs(q))
    q += period * math.floor((near - q) / period + 0.5)
    if q < low - slack:
        inside = q + period * math.ceil((low - slack - q) / period)
        return inside if inside <= high + slack else q
    if q > high + slack:
        inside = q - period * math.ceil((q - high - slack) / period)
        return inside if inside >= low - slack else q
    return q


@compiled
def nearest_first(vector: Floats, revolute: Bools, low: Floats, high: Floats, near: Floats, turns: Floats) -> None:
    """Make joint values of the two solutions `turns` (2, 3), wound towards `near`, and order them by their distance."""
    far = np.zeros(2)
    for branch in range(2):
        which = 0
        for link in range(revolute.size):
            if revolute[link]:
                scale = 1.0 + vector[STRIDE * link + GAIN]
                turns[branch, which] = wind(
                    turns[branch, which] / scale, _TURN / abs(scale), near[link], low[link], high[link]
                )
                far[branch] += (turns[branch, which] - near[link]) ** 2
                which += 1
    if far[1] < far[0]:
        for which in range(3):
            turns[0, which], turns[1, which] = turns[1, which], turns[0, which]


@compiled
def place_prismatic(vector: Floats, revolute: Bools, frame: Floats, axes: Floats, error: Floats, q: Floats) -> float:
    """Move three prismatic joints, standing at `q`, by the position error; returns the determinant of their axes."""
    used, a, cross, right = 0, np.empty((3, 3)), np.empty((3, 3)), np.zeros(3)
    for link in range(revolute.size):
        if not revolute[link]:
            for i in range(3):
                a[used, i] = axes[link, 2, i] * (1.0 + vector[STRIDE * link + GAIN])
            used += 1
    for row in range(3):
        b, c = (row + 1) % 3, (row + 2) % 3
        for i in range(3):
            one, two = (i + 1) % 3, (i + 2) % 3
            cross[row, i] = a[b, one] * a[c, two] - a[b, two] * a[c, one]
            right[row] += cross[row, i] * error[i]
    volume = a[0, 0] * cross[0, 0] + a[0, 1] * cross[0, 1] + a[0, 2] * cross[0, 2]
    used = 0
    for link in range(revolute.size):
        if not revolute[link]:
            if abs(volume) > 1e-12:
                q[link] += right[used] / volume
            used += 1
    product: float = volume
    return product


@compiled
def determinant(matrix: Floats, n: int) -> float:
    """Determinant by elimination with row exchange; destroys `matrix`."""
    result = 1.0
    for i in range(n):
        best = i
        for k in range(i + 1, n):
            if abs(matrix[k, i]) > abs(matrix[best, i]):
                best = k
        if matrix[best, i] == 0.0:
            return 0.0
        if best != i:
            result = -result
            for j in range(i, n):
                matrix[i, j], matrix[best, j] = matrix[best, j], matrix[i, j]
        result *= matrix[i, i]
        for k in range(i + 1, n):
            factor = matrix[k, i] / matrix[i, i]
            for j in range(i + 1, n):
                matrix[k, j] -= factor * matrix[i, j]
    return result


@compiled
def axes_volume(revolute: Bools, axes: Floats) -> float:
    """Determinant of the directions of the first three revolute axes; `axes` as by `chain_axes`."""
    used, matrix = 0, np.empty((3, 3))
    for link in range(revolute.size):
        if revolute[link] and used < 3:
            matrix[used] = axes[link, 2]
            used += 1
    return determinant(matrix, 3)
