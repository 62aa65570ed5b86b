"""A doubtful sweep drawn: its trace, the fringes found, where L turns, and what the fit leaves."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.count import Reading
from fpcal_bayes.fringes.profile import legendre
from fpcal_bayes.fringes.samples import Samples

# Okabe and Ito's colours.
_DATA, _FIT, _TURN, _FRINGE = "#777777", "#0072B2", "#D55E00", "#009E73"
#: Points of a fitted curve, and samples drawn at most.
_CURVE, _MOST = 4000, 20000


def draw_sweep(reading: Reading, samples: Samples, start: float, end: float, name: str, reason: str) -> Figure:
    """Draw one sweep.

    Parameters
    ----------
    reading, samples
        What the trace said, and the trace along the sweep.
    start, end
        Of the joint that moves, as a person reads it.
    name
        Of that joint with its unit.
    reason
        Why the sweep is doubtful; part of the title.
    """
    figure = Figure(figsize=(9.0, 6.5), layout="constrained")
    figure.suptitle(f"{reading.label}: {reason}", fontsize=10, wrap=True)
    step = max(1, len(samples) // _MOST)
    joint = (start + end) / 2.0 + samples.s[::step] * (end - start) / 2.0
    if reading.fit is None:
        _trace_alone(figure.subplots(), joint, samples.signal[::step], name)
        return figure
    trace, course, left = figure.subplots(3, 1, sharex=True, height_ratios=(2.0, 1.2, 1.0))
    s = np.linspace(-1.0, 1.0, _CURVE)
    along = (start + end) / 2.0 + s * (end - start) / 2.0
    order = np.argsort(samples.s, kind="stable")
    time = np.interp(s, samples.s[order], samples.time[order])
    fitted = reading.fit.signal(s, time, reading.phase_per_um)
    _trace_alone(trace, joint, samples.signal[::step], "")
    trace.plot(along, fitted, color=_FIT, linewidth=0.9, label="fit")
    _fringes(trace, reading, s, along, fitted)

    lengths = legendre(s)[:, 1:] @ (reading.course if len(reading.course) else reading.fit.course)
    course.plot(along, lengths - lengths[0], color=_FIT, linewidth=1.2)
    course.set_ylabel("L - L(start) [um]")
    for other in reading.alternatives:
        course.axhline(other, color=_TURN, linestyle=":", linewidth=1.0)
    if reading.alternatives:
        course.plot([], [], color=_TURN, linestyle=":", label="another dL that is possible")
        course.legend(loc="best", fontsize=7)

    residual = samples.signal[::step] - reading.fit.signal(
        samples.s[::step], samples.time[::step], reading.phase_per_um
    )
    left.plot(joint, residual, ".", color=_DATA, markersize=2 if len(joint) > 400 else 5)
    left.axhspan(-reading.fit.noise, reading.fit.noise, color=_FIT, alpha=0.2, linewidth=0, label="noise, one sd")
    left.set_ylabel("residual [V]")
    left.legend(loc="upper right", fontsize=7)
    left.set_xlabel(name)
    turns = _turning_joints(reading, start, end)
    for axis in (trace, course, left):
        for turn in turns:
            axis.axvline(turn, color=_TURN, linewidth=1.0)
        axis.grid(alpha=0.3)
    if turns:
        trace.plot([], [], color=_TURN, label="L turns")
    trace.legend(loc="upper right", fontsize=7, ncols=4)
    return figure


def _trace_alone(axis: Axes, joint: Floats, signal: Floats, name: str) -> None:
    axis.plot(joint, signal, ".", color=_DATA, markersize=2 if len(joint) > 400 else 5, label="samples")
    axis.set_ylabel("irradiance [V]")
    if name:
        axis.set_xlabel(name)
        axis.grid(alpha=0.3)


def _fringes(axis: Axes, reading: Reading, s: Floats, along: Floats, fitted: Floats) -> None:
    """Mark the tops of the fringes that were found."""
    if reading.fit is None:
        return
    turned = reading.fit.phase(s, reading.phase_per_um) / (2.0 * np.pi)
    tops = np.flatnonzero(np.diff(np.floor(turned)) != 0)
    axis.plot(along[tops], fitted[tops], "v", color=_FRINGE, markersize=4, label=f"{reading.fringes:.2f} fringes")


def _turning_joints(reading: Reading, start: float, end: float) -> list[float]:
    """Joint positions of the reversals in the unit of `start` and `end`."""
    if not reading.turns:
        return []
    return [(start + end) / 2.0 + turn * (end - start) / 2.0 for turn in reading.turns]
