"""Error of the circle through the week and sweeps spent, by the paper's protocol, the filter and the policy."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from rich.table import Table

from fpcal_bayes.core.files import replacing
from fpcal_bayes.model.parameters import Parameter
from fpcal_bayes.report.fit import plain_table
from fpcal_bayes.study.paper_scenarios import Course, Followed
from fpcal_bayes.study.paper_week import SESSIONS, Circle, Week
from fpcal_bayes.tracking.drift import DriftModel
from fpcal_bayes.tracking.filter import predict
from fpcal_bayes.tracking.session import SessionOutcome


def circle_table(title: str, circles: Sequence[Circle], tolerance: float) -> Table:
    """Peak to peak of the cavity length along each circle; `tolerance` in um."""
    table = plain_table(title, ["circle", "estimate of", "time h", "peak to peak nm", "in tolerance"])
    for circle in circles:
        inside = "yes" if circle.peak_to_peak <= tolerance else "no"
        table.add_row(circle.name, circle.estimate, f"{circle.time_h:g}", f"{1e3 * circle.peak_to_peak:.1f}", inside)
    return table


def course_table(courses: Sequence[Course]) -> Table:
    """What each way through the week held and cost."""
    tolerance = 1e3 * courses[0].tolerance
    columns = ["way through the week", f"within {tolerance:g} nm", "worst nm", "sessions", "sweeps", "minutes"]
    table = plain_table("After day 0: share of the time in which the circle holds, and what was spent", columns)
    for course in courses:
        table.add_row(
            course.name,
            f"{100 * course.share:.1f} %",
            f"{1e3 * course.peaks.max():.0f}",
            str(len(course.session_h) - 1),
            str(course.spent),
            f"{course.minutes:.0f}",
        )
    return table


# Okabe and Ito's colours, told apart by colour-blind readers and in grey print.
_TRUTH, _FULL, _EXTRINSIC = "#000000", "#0072B2", "#D55E00"
_POLICY, _FILTER = "#009E73", "#CC79A7"
#: Times at which a band is drawn between two sessions, both included.
_BETWEEN = 4


def draw_week(week: Week, followed: Followed | None = None) -> Figure:
    """Draw each extrinsic parameter against time: truth, estimates, and two standard deviations of each.

    Parameters
    ----------
    followed
        Filter and policy, whose bands are drawn too.
    """
    parameters = [p for p in week.cell.free if p.kind == "extrinsic"]
    figure = Figure(figsize=(10, 7.5), layout="constrained")
    axes = figure.subplots(-(-len(parameters) // 2), 2, squeeze=False, sharex=True)
    hours = np.linspace(0.0, 24.0 * SESSIONS[-1].day, 200)
    truth = week.truth.parameters.to_shown(week.truth.at(hours))
    for axis, parameter in zip(axes.flat, parameters, strict=False):
        true = truth[:, week.truth.parameters.position(parameter.name)]
        if followed is not None:
            drift = followed.track.drift
            days, low, high = _band(drift, parameter, followed.loop.outcomes, hours[-1])
            axis.fill_between(days, low, high, color=_POLICY, alpha=0.25, linewidth=0, label="policy")
            days, low, high = _band(drift, parameter, followed.track.outcomes, hours[-1])
            axis.plot(days, low, "--", color=_FILTER, linewidth=0.8, label="filter, the same sweeps")
            axis.plot(days, high, "--", color=_FILTER, linewidth=0.8)
        axis.plot(hours / 24.0, true, color=_TRUTH, linewidth=1, label="truth")
        for kind, colour, marker in (("all", _FULL, "o"), ("extrinsic", _EXTRINSIC, "s")):
            chosen = [s for s in SESSIONS if s.free == kind]
            shown = [week.identifications[s.name].estimate.shown()[parameter.name] for s in chosen]
            axis.errorbar(
                [s.day for s in chosen],
                [entry["value"] for entry in shown],
                [2 * entry["sd"] for entry in shown],
                fmt=marker,
                color=colour,
                markersize=4,
                capsize=3,
                linewidth=1,
                label="full identification" if kind == "all" else "extrinsic only, day-2 intrinsics",
            )
        axis.set_ylabel(parameter.latex)
        axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("time [days]")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9
    )
    return figure


def _band(
    drift: DriftModel, parameter: Parameter, outcomes: Sequence[SessionOutcome], end_h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Days, and two standard deviations to either side of what was known then, in the units a person reads."""
    at = drift.parameters.position(parameter.name)
    until = [outcome.time_h for outcome in outcomes[1:]] + [max(end_h, outcomes[-1].time_h)]
    points = []
    for outcome, end in zip(outcomes, until, strict=True):
        for time_h in np.linspace(outcome.time_h, end, _BETWEEN):
            state = predict(drift, outcome.state, float(time_h))
            mean, variance = drift.values(state.mean)[at], drift.covariance(state.covariance)[at, at]
            points.append((time_h / 24.0, mean, 2.0 * np.sqrt(variance)))
    days, mean, width = np.array(points).T
    return days, (mean - width) / parameter.scale, (mean + width) / parameter.scale


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG or PNG by the suffix of `path`; the same figure gives the same bytes."""
    with matplotlib.rc_context({"svg.hashsalt": "fpcal"}), replacing(path) as temporary:
        kind = path.suffix.lstrip(".")
        # The date would make two runs differ.
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(temporary, format=kind, dpi=130, metadata=metadata)


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


#: Okabe and Ito's vermilion, sky blue and black-blue, with line styles that tell them apart in grey print.
_STYLES = (("#D55E00", "-"), ("#56B4E9", "--"), ("#0072B2", "-"))


def draw_courses(courses: Sequence[Course]) -> Figure:
    """Draw the error at each time above, the number of sweeps spent after day 0 below."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    error, spent = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for course, (colour, style) in zip(courses, _STYLES, strict=True):
        text = f"{course.name}: {100 * course.share:.1f} % of the time in tolerance, {course.spent} sweeps"
        error.plot(course.times_h / 24.0, 1e3 * course.peaks, style, color=colour, linewidth=0.9, label=text)
        days = np.append(course.session_h, course.times_h[-1]) / 24.0
        total = np.cumsum(np.append(0, course.session_sweeps[1:]))
        spent.step(days, np.append(total, total[-1]), style, where="post", color=colour, linewidth=1.2)
    tolerance = 1e3 * courses[0].tolerance
    error.axhline(tolerance, color="black", linewidth=0.8, linestyle=":", label=f"tolerance {tolerance:g} nm")
    error.set(yscale="log", ylim=(1.0, None), ylabel="error of the circle, peak to peak [nm]")
    error.yaxis.set_major_formatter("{x:g}")
    spent.set(xlabel="time [days]", ylabel="sweeps after day 0", xlim=(0, courses[0].times_h[-1] / 24.0))
    for axis in (error, spent):
        axis.grid(alpha=0.3)
    figure.legend(loc="outside upper center", fontsize=8, frameon=False)
    return figure
