"""Compiled kernel: follow the phase of fringes through their extremes."""

import math

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.model.compiled import compiled

Floats = NDArray[np.float64]


@compiled
def follow_phase(height: Floats, sd: Floats, expected: Floats, start_sd: float, speed_sd: float, jerk: float) -> Floats:
    """Excess of a phase over the expected one, by an extended Kalman filter.

    State are the excess and its speed per sample, driven by white noise; each sample measures cos(expected + excess).
    Near an extreme, where a sample says nothing about the phase, the speed carries it over.

    Parameters
    ----------
    height
        Measured cosines, shape (n,).
    sd
        Their standard deviations, shape (n,).
    expected
        Expected phase in rad, shape (n,).
    start_sd, speed_sd
        Standard deviations of the excess and its speed (per sample) at the start; the excess starts at zero.
    jerk
        Spectral density of the acceleration, in rad^2 per sample^3.

    Returns
    -------
    ndarray
        Excess in rad, shape (n,), each from the samples up to it.
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
