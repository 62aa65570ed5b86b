"""Compiled kernels of fringe reading: profiles searched for, a signal fitted, a phase followed through extremes."""

import math

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled

#: Harmonics of a fringe whose sizes are fitted, two numbers each for the second and the third.
HARMONICS = 4
#: What is fitted: Legendre polynomials from P_0 on over time and over the place, (.., n); what averages leave of the
#: height (n,); coefficients of A, of log B over time, of log B over the place; known phase (n,) and derivatives of the
#: phase (n_modes, n); signal and its inverse standard deviations, (n,).
SignalData = tuple[Floats, Floats, Floats, NDArray[np.int64], Floats, Floats, Floats, Floats]


@compiled
def legendre_table(s: Floats, degree: int) -> Floats:
    """Legendre polynomials P_0 .. P_degree at `s` (n,), shape (n, degree + 1)."""
    table = np.empty((s.size, degree + 1))
    for i in range(s.size):
        table[i, 0] = 1.0
        if degree > 0:
            table[i, 1] = s[i]
        for k in range(2, degree + 1):
            table[i, k] = ((2.0 * k - 1.0) * s[i] * table[i, k - 1] - (k - 1.0) * table[i, k - 2]) / k
    return table


@compiled
def turned_bins(
    signal: Floats, place: Ints, base: Floats, bend: Floats, bends: Floats, n_bins: int
) -> NDArray[np.complex128]:
    """Signal (n,) turned back by the phase base + bend of each of `bends` (m,) and summed into the bins `place` (n,).

    Returns shape (m, n_bins): its Fourier transform along the bins tells how well each slope fits.
    """
    bins = np.zeros((bends.size, n_bins), dtype=np.complex128)
    for i in range(bends.size):
        for k in range(signal.size):
            f = base[k] + bends[i] * bend[k]
            bins[i, place[k]] += signal[k] * complex(np.cos(f), -np.sin(f))
    return bins


@compiled
def floating_fits(
    s: Floats, signal: Floats, weight: Floats, base: Floats, slope: Floats, bend: Floats, slopes: Floats, bends: Floats
) -> Floats:
    """Sum of squares left by 1, s, s^2, cos f and sin f for each slope and bend, shape (n_slopes, n_bends).

    Few fringes and a curved offset look alike: here both are fitted together.
    """
    left = np.empty((slopes.size, bends.size))
    matrix, vector, row = np.empty((5, 5)), np.empty(5), np.empty(5)
    total = 0.0
    for k in range(s.size):
        total += weight[k] * signal[k] * signal[k]
    for a in range(slopes.size):
        for b in range(bends.size):
            matrix[:] = 0.0
            vector[:] = 0.0
            for k in range(s.size):
                f = base[k] + slopes[a] * slope[k] + bends[b] * bend[k]
                row[0], row[1], row[2], row[3], row[4] = 1.0, s[k], s[k] * s[k], np.cos(f), np.sin(f)
                for i in range(5):
                    scaled = weight[k] * row[i]
                    vector[i] += scaled * signal[k]
                    for j in range(i + 1):
                        matrix[i, j] += scaled * row[j]
            # L D L' in place; a tiny ridge keeps a fringe that looks like a parabola solvable.
            explained = 0.0
            for i in range(5):
                pivot = matrix[i, i] * (1.0 + 1e-6) + 1e-12
                for j in range(i):
                    coupled = matrix[i, j]
                    for m in range(j):
                        coupled -= matrix[i, m] * matrix[j, m] * matrix[m, m]
                    matrix[i, j] = coupled / matrix[j, j]
                    pivot -= matrix[i, j] * coupled
                    vector[i] -= matrix[i, j] * vector[j]
                matrix[i, i] = pivot
                explained += vector[i] * vector[i] / pivot
            left[a, b] = total - explained
    return left


@compiled
def normal_equations(
    data: SignalData, unknowns: Floats, prior_mean: Floats, prior_weight: Floats, matrix: Floats, gradient: Floats
) -> float:
    """Fill J'WJ + prior and J'W(signal - model) + prior at `unknowns`; returns the sum of squares.

    prior_weight: the inverse of a covariance (p, p).
    """
    over_time, over_place, damping, counts, base, modes, signal, root = data
    n_modes, n = modes.shape
    n_offset, n_gain, n_fade = counts[0], counts[1], counts[2]
    fade_at = n_offset + n_gain
    mirror_at = fade_at + n_fade
    harmonic_at = mirror_at + 1
    phase_at = harmonic_at + HARMONICS
    h1, h2 = unknowns[harmonic_at], unknowns[harmonic_at + 1]
    h3, h4 = unknowns[harmonic_at + 2], unknowns[harmonic_at + 3]
    mirror = unknowns[mirror_at]
    rows = np.empty((unknowns.size, n))
    residual, change, slope = np.empty(n), np.empty(n), np.empty(n)
    f, offset, logarithm = base + unknowns[phase_at], np.zeros(n), np.zeros(n)
    for j in range(n_modes):
        f += modes[j] * unknowns[phase_at + 1 + j]
    for j in range(n_offset):
        offset += over_time[j] * unknowns[j]
        rows[j] = root * over_time[j]
    for j in range(n_gain):
        logarithm += over_time[j] * unknowns[n_offset + j]
    for j in range(n_fade):
        logarithm += over_place[j + 1] * unknowns[fade_at + j]
    for k in range(n):
        c, s = np.cos(f[k]), np.sin(f[k])
        c2, s2 = c * c - s * s, 2.0 * s * c
        c3, s3 = c2 * c - s2 * s, s2 * c + c2 * s
        b = np.exp(logarithm[k])
        d, light = b * damping[k], mirror * b * b
        wave = d * (c + h1 * c2 + h2 * s2 + h3 * c3 + h4 * s3)
        change[k] = root[k] * (wave + 2.0 * light)
        slope[k] = root[k] * d * (2.0 * (h2 * c2 - h1 * s2) + 3.0 * (h4 * c3 - h3 * s3) - s)
        residual[k] = root[k] * (signal[k] - offset[k] - light - wave)
        rows[mirror_at, k] = root[k] * b * b
        d *= root[k]
        rows[harmonic_at, k], rows[harmonic_at + 1, k] = d * c2, d * s2
        rows[harmonic_at + 2, k], rows[harmonic_at + 3, k] = d * c3, d * s3
    for j in range(n_gain):
        rows[n_offset + j] = change * over_time[j]
    for j in range(n_fade):
        rows[fade_at + j] = change * over_place[j + 1]
    rows[phase_at] = slope
    for j in range(n_modes):
        rows[phase_at + 1 + j] = slope * modes[j]
    off = prior_mean - unknowns
    pull = np.dot(prior_weight, off)
    matrix[:] = np.dot(rows, rows.T) + prior_weight
    gradient[:] = np.dot(rows, residual) + pull
    cost: float = np.dot(residual, residual) + np.dot(off, pull)
    return cost


@compiled
def damped_step(matrix: Floats, gradient: Floats, damping: float, factor: Floats, step: Floats) -> bool:
    """Solve (matrix + damping diagonal) step = gradient by Cholesky; False if it is not positive definite."""
    p = gradient.size
    for i in range(p):
        for j in range(i + 1):
            total = matrix[i, j]
            if i == j:
                total *= 1.0 + damping
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(p):
        total = gradient[i]
        for k in range(i):
            total -= factor[i, k] * step[k]
        step[i] = total / factor[i, i]
    for i in range(p - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, p):
            total -= factor[k, i] * step[k]
        step[i] = total / factor[i, i]
    return True


@compiled
def fit_signal(
    data: SignalData, unknowns: Floats, prior_mean: Floats, prior_weight: Floats, max_steps: int
) -> tuple[float, float, Floats]:
    """Levenberg-Marquardt from `unknowns`, which are improved in place.

    Returns the sum of squares reached, and of the normal equations there the logarithm of the determinant and the
    inverse (p, p), the covariance of the unknowns.
    """
    p = unknowns.size
    gradient, factor, step = np.empty(p), np.zeros((p, p)), np.empty(p)
    matrix = np.empty((p, p))
    trial, trial_matrix, trial_gradient = np.empty(p), np.empty((p, p)), np.empty(p)
    damped, cost = 1e-3, np.inf
    trial[:] = unknowns
    for number in range(max_steps + 1):
        reached = normal_equations(data, trial, prior_mean, prior_weight, trial_matrix, trial_gradient)
        if reached <= cost:
            gain = cost - reached
            unknowns[:], matrix[:], gradient[:] = trial, trial_matrix, trial_gradient
            cost = reached
            damped = max(0.1 * damped, 1e-9)
            if gain < 1e-4:
                break
        else:
            damped *= 8.0
            if damped > 1e8:
                break
        if number == max_steps:
            break
        while not damped_step(matrix, gradient, damped, factor, step):
            damped = max(10.0 * damped, 1e-3)
        trial[:] = unknowns + step
    damped_step(matrix, gradient, 0.0, factor, step)
    return cost, 2.0 * np.log(np.diag(factor)).sum(), np.linalg.inv(matrix)


@compiled
def follow_phase(height: Floats, sd: Floats, expected: Floats, start_sd: float, speed_sd: float, jerk: float) -> Floats:
    """Excess (n,) in rad of a phase over the `expected` one, by an extended Kalman filter.

    State are the excess, zero to begin with, and its speed per sample, of standard deviations start_sd and speed_sd,
    driven by white noise of spectral density `jerk` (rad^2 per sample^3); each sample measures cos(expected + excess)
    with `sd`. Near an extreme, where a sample says nothing about the phase, the speed carries it over.
    """
    result = np.empty(height.size)
    excess, speed = 0.0, 0.0
    p00, p01, p11 = start_sd**2, 0.0, speed_sd**2
    for i in range(height.size):
        if i > 0:
            excess += speed
            p00 += 2.0 * p01 + p11 + jerk / 3.0
            p01 += p11 + jerk / 2.0
            p11 += jerk
        phase = expected[i] + excess
        slope = -math.sin(phase)
        # What the curvature hides counts as noise, so that a wide state does not believe a flat top.
        variance = sd[i] ** 2 + 0.5 * (math.cos(phase) * p00) ** 2
        innovation = p00 * slope * slope + variance
        gain0, gain1 = p00 * slope / innovation, p01 * slope / innovation
        surprise = height[i] - math.cos(phase)
        excess += gain0 * surprise
        speed += gain1 * surprise
        p11 -= gain1 * slope * p01
        p01 -= gain0 * slope * p01
        p00 -= gain0 * slope * p00
        result[i] = excess
    return result
