"""Traces from a simulator of a few lines, which shares nothing with the program but the cavity length."""

import numpy as np

from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.traces import Trace, WavelengthScan
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell


def bent(random: np.random.Generator, u: np.ndarray, size: float) -> np.ndarray:
    """A ramp and a bow of random shares and signs over u from 0 to 1, `size` from peak to peak in all."""
    share, signs = random.uniform(), random.choice([-1.0, 1.0], 2)
    return size * (share * signs[0] * (u - 0.5) + (1 - share) * signs[1] * (4 * u * (1 - u) - 0.5))


def irradiance(random: np.random.Generator, phase: np.ndarray, time: np.ndarray, *, noise: float = 0.01) -> np.ndarray:
    """A photodiode that sees `phase` at `time` from 0 to 1: all that the acceptance asks for disturbs it."""
    amplitude = 1.0 + bent(random, time, 0.2)
    cyclic = 0.01 * np.cos(2.0 * phase + random.uniform(0.0, 2.0 * np.pi))
    clean = 1.5 + bent(random, time, 0.1) + amplitude * (np.cos(phase) + cyclic)
    return clean + noise * random.standard_normal(len(phase))


def record(
    cell: Cell,
    model: CavityModel,
    values: np.ndarray,
    sweep: Sweeps,
    random: np.random.Generator,
    samples_a_fringe: float = 60.0,
    noise: float = 0.01,
) -> Trace:
    """The trace of one sweep, with 10 % velocity ripple and `samples_a_fringe` where L changes fastest."""
    start, end = sweep.q_start[0], sweep.q_end[0]

    def length(share: np.ndarray) -> np.ndarray:
        return model.predict(values, model.pose_rows(start + share[:, None] * (end - start)))

    steps = np.abs(np.diff(length(np.linspace(0.0, 1.0, 201)))) * 200.0 / (cell.wavelength / 2.0)
    n = max(24, int(1.1 * steps.max() * samples_a_fringe))
    time = np.linspace(0.0, 1.0, n)
    turn, begin = 2.0 * np.pi * random.integers(3, 12), random.uniform(0.0, 2.0 * np.pi)
    share = time + 0.1 / turn * (np.sin(turn * time + begin) - np.sin(begin))
    share[-1] = 1.0
    phase = 4.0 * np.pi / cell.wavelength * length(share) + random.uniform(0.0, 2.0 * np.pi)
    joint = int(np.argmax(start != end))
    volts = np.rint(irradiance(random, phase, time, noise=noise) * 13107.0) / 13107.0
    return Trace(10.0 * time, start[joint] + share * (end - start)[joint], volts)


def scan(random: np.random.Generator, length: float, n: int = 801) -> WavelengthScan:
    """A wavelength scan from 1,520 to 1,600 nm of a cavity of `length` um."""
    wavelength = np.linspace(1.52, 1.60, n)
    phase = 4.0 * np.pi * length / wavelength + random.uniform(0.0, 2.0 * np.pi)
    return WavelengthScan(wavelength, irradiance(random, phase, np.linspace(0.0, 1.0, n)))


def record_all(
    cell: Cell, model: CavityModel, values: np.ndarray, sweeps: Sweeps, seed: int, samples_a_fringe: float = 60.0
) -> TraceIndex:
    """Traces of all sweeps, without scans."""
    random = np.random.default_rng(seed)
    traces = [
        record(cell, model, values, sweeps.take(np.array([i])), random, samples_a_fringe) for i in range(len(sweeps))
    ]
    return TraceIndex.of(sweeps, traces)
