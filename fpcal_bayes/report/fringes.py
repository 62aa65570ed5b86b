"""A doubtful sweep drawn: its trace, the fringes found, where L turns, and what the fit leaves."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fpcal_bayes.analysis.traces import FittedSweep
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.count import Reading
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.report.pages import BLUE, GREEN, VERMILION

_DATA = "#777777"
#: Samples drawn at most.
_MOST = 20000


def draw_sweep(reading: Reading, samples: Samples, start: float, end: float, name: str, reason: str) -> Figure:
    """Draw a trace and its reading over the joint from `start` to `end` with the reason for doubt."""
    figure = Figure(figsize=(9.0, 6.5), layout="constrained")
    figure.suptitle(f"{reading.label}: {reason}", fontsize=10, wrap=True)
    step = max(1, len(samples) // _MOST)
    joint = (start + end) / 2.0 + samples.s[::step] * (end - start) / 2.0
    fitted = FittedSweep.of(reading, samples)
    if fitted is None:
        _trace_alone(figure.subplots(), joint, samples.signal[::step], name)
        return figure
    trace, profile, left = figure.subplots(3, 1, sharex=True, height_ratios=(2.0, 1.2, 1.0))
    along = (start + end) / 2.0 + fitted.s * (end - start) / 2.0
    _trace_alone(trace, joint, samples.signal[::step], "")
    trace.plot(along, fitted.signal, color=BLUE, linewidth=0.9, label="fit")
    tops, found = fitted.tops, f"{reading.fringes:.2f} fringes"
    trace.plot(along[tops], fitted.signal[tops], "v", color=GREEN, markersize=4, label=found)

    profile.plot(along, fitted.lengths, color=BLUE, linewidth=1.2)
    profile.set_ylabel("L - L(start) [um]")
    fringe = 2.0 * np.pi / reading.phase_per_um
    beside = profile.secondary_yaxis("right", functions=(lambda x: x / fringe, lambda x: x * fringe))
    beside.set_ylabel("phase [fringes]")
    for other in reading.alternatives:
        profile.axhline(other, color=VERMILION, linestyle=":", linewidth=1.0)
    if reading.alternatives:
        profile.plot([], [], color=VERMILION, linestyle=":", label="another dL that is possible")
        profile.legend(loc="best", fontsize=7)

    left.plot(joint, fitted.residual[::step], ".", color=_DATA, markersize=2 if len(joint) > 400 else 5)
    left.axhspan(-fitted.noise, fitted.noise, color=BLUE, alpha=0.2, linewidth=0, label="noise, one sd")
    left.set(xlabel=name, ylabel="residual [V]")
    left.legend(loc="upper right", fontsize=7)
    for axis in (trace, profile, left):
        for turn in reading.turns:
            axis.axvline((start + end) / 2.0 + turn * (end - start) / 2.0, color=VERMILION, linewidth=1.0)
        axis.grid(alpha=0.3)
    if reading.turns:
        trace.plot([], [], color=VERMILION, label="L turns")
    if reading.late:
        moves = ((start + end) / 2.0 + place * (end - start) / 2.0 for place in (reading.set_out, reading.stop))
        for joint_end, place in zip((start, end), moves, strict=True):
            trace.axvspan(joint_end, place, color=VERMILION, alpha=0.15, linewidth=0)
        trace.plot([], [], color=VERMILION, alpha=0.15, linewidth=6.0, label="the mirror stands still")
    trace.legend(loc="upper right", fontsize=7, ncols=4)
    return figure


def _trace_alone(axis: Axes, joint: Floats, signal: Floats, name: str) -> None:
    axis.plot(joint, signal, ".", color=_DATA, markersize=2 if len(joint) > 400 else 5, label="samples")
    axis.set_ylabel("irradiance [V]")
    if name:
        axis.set_xlabel(name)
        axis.grid(alpha=0.3)
