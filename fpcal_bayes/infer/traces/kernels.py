"""Compiled kernel: what the samples of many traces say, compressed into one small matrix a trace."""

import math

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled


@compiled
def trace_grams(
    first: Ints,
    place: Floats,
    time: Floats,
    envelope: Floats,
    irradiance: Floats,
    series: Floats,
    levels: Floats,
    wave_number: Floats,
    noise: Floats,
    length_noise: float,
) -> tuple[Floats, Floats]:
    """Gram matrices of derivatives and residuals.

    A trace s has the samples ``first[s]`` to ``first[s + 1]`` and the model

        I = a(t) + m e^2 + e b(t) cos(p) + e h cos(2 p) + e g sin(2 p),    p = k sum_j c_j T_j(x) + phase,

    T_j Chebyshev polynomials, j = 1 .. J, a and b polynomials of the time, e a known envelope; m is the light that
    comes back from the mirror alone, h and g are a second harmonic.

    first: shape (n_traces + 1,).
    place, time: x and t from -1 to 1, shape (n_samples,).
    envelope, irradiance: shape (n_samples,).
    series: c, shape (n_traces, J).
    levels: coefficients of a, those of b, then m, h, g and the phase, shape (n_traces, 2 d + 4).
    wave_number, noise: k, and standard deviation of a sample, shape (n_traces,).
    length_noise: standard deviation of independent noise on the length at each sample.
    Returns weighted inner products, by the inverse variance, of the columns: derivatives by c, derivatives by the
    levels, residual; shape (n_traces, J + 2 d + 5, same). Sum of squares of the residuals themselves, shape
    (n_traces,).
    """
    n_series, n_levels = series.shape[1], levels.shape[1]
    degree, width = n_levels // 2 - 2, n_series + n_levels + 1
    grams, squares = np.zeros((first.size - 1, width, width)), np.zeros(first.size - 1)
    row = np.empty(width)
    for s in range(first.size - 1):
        gram = grams[s]
        for i in range(first[s], first[s + 1]):
            x, length = place[i], 0.0
            before, now = 1.0, x
            for j in range(n_series):
                row[j] = now
                length += series[s, j] * now
                before, now = now, 2.0 * x * now - before
            square = envelope[i] * envelope[i]
            mean, height, power = levels[s, 2 * degree] * square, 0.0, 1.0
            for j in range(degree):
                mean += levels[s, j] * power
                height += levels[s, degree + j] * power
                power *= time[i]
            phase = wave_number[s] * length + levels[s, n_levels - 1]
            cosine, sine = math.cos(phase), math.sin(phase)
            cosine2, sine2 = cosine * cosine - sine * sine, 2.0 * sine * cosine
            even, odd = levels[s, 2 * degree + 1], levels[s, 2 * degree + 2]
            turn = -envelope[i] * (height * sine + 2.0 * even * sine2 - 2.0 * odd * cosine2)
            slope = turn * wave_number[s]
            for j in range(n_series):
                row[j] *= slope
            power = 1.0
            for j in range(degree):
                row[n_series + j] = power
                row[n_series + degree + j] = power * envelope[i] * cosine
                power *= time[i]
            row[n_series + 2 * degree] = square
            row[n_series + 2 * degree + 1] = envelope[i] * cosine2
            row[n_series + 2 * degree + 2] = envelope[i] * sine2
            row[n_series + n_levels - 1] = turn
            left = irradiance[i] - mean - envelope[i] * (height * cosine + even * cosine2 + odd * sine2)
            row[width - 1] = left
            squares[s] += left * left
            # To second order, so that an extreme of the fringe is not taken as free of noise.
            curved = envelope[i] * height * cosine * wave_number[s] ** 2 * length_noise**2
            weight = 1.0 / (noise[s] ** 2 + (slope * length_noise) ** 2 + 0.5 * curved**2)
            for j in range(width):
                scaled = weight * row[j]
                for m in range(j + 1):
                    gram[j, m] += scaled * row[m]
        for j in range(width):
            for m in range(j):
                gram[m, j] = gram[j, m]
    return grams, squares
