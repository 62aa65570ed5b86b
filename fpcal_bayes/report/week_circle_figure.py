"""The circles of the week: the paper's Figs 13 and 14 on the simulated cell."""

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from fpcal_bayes.week_circle import Circle

#: From dark to light in any print and for any eye; its yellow end is too pale for a line.
_SEQUENCE = colormaps["viridis"]
_PALEST = 0.9
#: Okabe and Ito's orange and blue.
_STALE, _RENEWED = "#D55E00", "#0072B2"


def draw_circles(checks: Sequence[Circle], renewed: Sequence[Circle]) -> Figure:
    """Draw the change of cavity length and the irradiance along each circle.

    Parameters
    ----------
    checks
        With the estimate of day 0, at one time after the other.
    renewed
        Before and after each identification; their names begin with ``before-`` or ``after-``.
    """
    figure = Figure(figsize=(10, 8.5), layout="constrained")
    halves = figure.subfigures(2, 1, squeeze=False)
    _draw_checks(halves[0, 0], checks)
    _draw_renewed(halves[1, 0], renewed)
    return figure


def _draw_checks(figure: SubFigure, checks: Sequence[Circle]) -> None:
    figure.suptitle("circle with the estimate of day 0 (the paper's Fig 13)", fontsize=10)
    length, light = figure.subplots(1, 2)
    colours = [_SEQUENCE(_PALEST * i / max(1, len(checks) - 1)) for i in range(len(checks))]
    recorded = [_along_path(check) for check in checks]
    step = 1.2 * max(float(np.ptp(irradiance)) for _, irradiance in recorded)
    for number, (check, colour, (phase, irradiance)) in enumerate(zip(checks, colours, recorded, strict=True)):
        name = f"{check.time_h:g} h: {1e3 * check.peak_to_peak:.0f} nm"
        length.plot(check.phase, 1e3 * check.change, color=colour, label=name)
        # Checks start on a rising or a falling flank of a fringe, whichever is nearer.
        shifted = irradiance - irradiance[0] + number * step
        light.plot(phase, shifted, color=colour, linewidth=0.6)
        light.annotate(f"{check.time_h:g} h", (362.0, shifted[-1]), va="center", fontsize=7, annotation_clip=False)
    _label(length, "change of cavity length [nm]")
    _label(light, "change of irradiance, shifted [V]")
    length.legend(title="time and peak to peak", fontsize=7, title_fontsize=7)


def _draw_renewed(figure: SubFigure, renewed: Sequence[Circle]) -> None:
    figure.suptitle("circle at each identification, with the estimate before and the new one (Fig 14)", fontsize=10)
    sessions = list(dict.fromkeys(circle.name.partition("-")[2] for circle in renewed))
    axes = figure.subplots(1, len(sessions), sharey=True, squeeze=False)[0]
    for axis, session in zip(axes, sessions, strict=True):
        peaks = []
        for when, colour, style in (("before", _STALE, "--"), ("after", _RENEWED, "-")):
            for circle in renewed:
                if circle.name == f"{when}-{session}":
                    axis.plot(circle.phase, 1e3 * circle.change, style, color=colour, label=when)
                    peaks.append(f"{1e3 * circle.peak_to_peak:.0f} nm")
        axis.set_title(f"{session}\n{' before, '.join(peaks)} after", fontsize=8)
        _label(axis, "")
        axis.set_xticks((0, 180, 360))
    axes[0].set_ylabel("change of cavity length [nm]")
    lines = axes[-1].get_lines()
    figure.legend(lines, ["estimate before", "new estimate"], loc="outside lower center", ncols=2, frameon=False)


def _along_path(circle: Circle) -> tuple[np.ndarray, np.ndarray]:
    """Phase in deg and irradiance of the samples of the path itself."""
    path = circle.trace.path
    time = circle.trace.time_s[path]
    share = (time - time[0]) / (time[-1] - time[0])
    return np.interp(share, np.linspace(0.0, 1.0, len(circle.phase)), circle.phase), circle.trace.irradiance[path]


def _label(axis: Axes, y: str) -> None:
    axis.set(xlabel="phase on the circle [deg]", ylabel=y, xlim=(0, 360), xticks=(0, 90, 180, 270, 360))
    axis.grid(alpha=0.3)
