"""Compiled kernels of fringe reading: profiles searched for, a signal fitted, a phase followed through extremes."""

import math

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.typing import Floats
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
def sums_in_bins(place: NDArray[np.int64], values: tuple[Floats, ...], n_bins: int) -> Floats:
    """Sums (m, n_bins) of m rows of values (n,) that stand at `place` (n,)."""
    sums = np.zeros((len(values), n_bins))
    for i in range(place.size):
        for j in range(len(values)):
            sums[j, place[i]] += values[j][i]
    return sums


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
    c, s = np.cos(f), np.sin(f)
    c2, s2 = c * c - s * s, 2.0 * s * c
    c3, s3 = c2 * c - s2 * s, s2 * c + c2 * s
    b = np.exp(logarithm)
    d, light = root * b * damping, root * b * b
    wave = d * (c + h1 * c2 + h2 * s2 + h3 * c3 + h4 * s3)
    change = wave + 2.0 * mirror * light
    slope = d * (2.0 * (h2 * c2 - h1 * s2) + 3.0 * (h4 * c3 - h3 * s3) - s)
    residual = root * (signal - offset) - mirror * light - wave
    rows[mirror_at] = light
    for j, harmonic in enumerate((c2, s2, c3, s3)):
        rows[harmonic_at + j] = d * harmonic
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
def fit_signal(
    data: SignalData, unknowns: Floats, prior_mean: Floats, prior_weight: Floats, max_steps: int
) -> tuple[float, float, Floats]:
    """Levenberg-Marquardt from `unknowns`, which are improved in place.

    Returns the sum of squares reached, and the log determinant and the inverse (p, p) of the normal equations there.
    """
    p = unknowns.size
    gradient, matrix = np.empty(p), np.empty((p, p))
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
        # Prior weights differ by many orders: with its diagonal scaled to one the matrix is never singular to rounding.
        scale = 1.0 / np.sqrt(np.diag(matrix))
        scaled = matrix * np.outer(scale, scale) + damped * np.eye(p)
        trial[:] = unknowns + scale * np.linalg.solve(scaled, scale * gradient)
    scale = 1.0 / np.sqrt(np.diag(matrix))
    scales = np.outer(scale, scale)
    return cost, np.linalg.slogdet(matrix)[1], np.linalg.inv(matrix * scales) * scales


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
        innovation = p00 * slope * slope + (sd[i] ** 2 + 0.5 * (math.cos(phase) * p00) ** 2)
        gain0, gain1 = p00 * slope / innovation, p01 * slope / innovation
        surprise = height[i] - math.cos(phase)
        excess += gain0 * surprise
        speed += gain1 * surprise
        p11 -= gain1 * slope * p01
        p01 -= gain0 * slope * p01
        p00 -= gain0 * slope * p00
        result[i] = excess
    return result
