"""The paper's week as tables and figures: parameters beside the truth, circles, and what each way through it costs."""

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from fpcal_bayes.analysis.history import parameter_band
from fpcal_bayes.analysis.parameters import reflection_points
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.report.pages import BLACK, BLUE, GREEN, PURPLE, SKY, VERMILION
from fpcal_bayes.report.table import Table, TableCell, number, plain_table
from fpcal_bayes.study.paper_scenarios import Followed, Scenario
from fpcal_bayes.study.paper_week import SESSIONS, Circle, Week


def truth_table(estimate: Estimate, truth: Floats, names: Sequence[str], title: str) -> Table:
    """Identified values beside the truth of the parameters `names`, in um and rad, shape (n,)."""
    table = plain_table(title, ["parameter", "unit", "truth", "identified", "sd", "error / sd", "status"])
    shown = estimate.shown()
    for name, true in zip(names, truth, strict=True):
        parameter = estimate.cell.parameters[name]
        value, sd = shown[name]["value"], shown[name]["sd"]
        status = estimate.status[estimate.parameters.position(name)]
        table.add_row(
            name,
            parameter.unit,
            f"{parameter.shown(float(true)):.6g}",
            number(value, sd),
            number(sd, sd) if sd > 0 else "exact",
            f"{(value - parameter.shown(float(true))) / sd:+.1f}" if sd > 0 else "",
            TableCell(status, style=status),
        )
    return table


def reflection_lines(estimate: Estimate, true_parameters: ParameterSet, truth: Floats) -> list[str]:
    """The reflection point at joint vector zero, in the world and in the mirror frame, beside the truth.

    The truth holds values of `true_parameters` in um and rad, shape (n,).
    """
    lines = []
    for name, columns in reflection_points(estimate, true_parameters, truth).items():
        parts = (
            f"{axis} {number(value, sd)} +- {number(sd, sd)} (truth {true:.1f})"
            for axis, value, sd, true in zip("xyz", *columns, strict=False)
        )
        lines.append(f"reflection point {name} at q = 0 [um]: {', '.join(parts)}")
    return lines


def circle_table(title: str, circles: Sequence[Circle], tolerance: float) -> Table:
    """Peak to peak of the cavity length along each circle; `tolerance` in um."""
    table = plain_table(title, ["circle", "estimate of", "time [h]", "peak to peak [nm]", "in tolerance"])
    for circle in circles:
        inside = "yes" if circle.peak_to_peak <= tolerance else "no"
        table.add_row(circle.name, circle.estimate, f"{circle.time_h:g}", f"{1e3 * circle.peak_to_peak:.1f}", inside)
    return table


def course_table(courses: Sequence[Scenario]) -> Table:
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


def draw_week(week: Week, followed: Followed) -> Figure:
    """Draw each extrinsic parameter against time: truth, estimates, filter, policy; two standard deviations of each."""
    parameters = [p for p in week.cell.free if p.kind == "extrinsic"]
    figure = Figure(figsize=(10, 7.5), layout="constrained")
    axes = figure.subplots(-(-len(parameters) // 2), 2, squeeze=False, sharex=True)
    hours = np.linspace(0.0, 24.0 * SESSIONS[-1].day, 200)
    truth = week.truth.parameters.to_shown(week.truth.at(hours))
    for axis, parameter in zip(axes.flat, parameters, strict=False):
        true = truth[:, week.truth.parameters.position(parameter.name)]
        drift = followed.track.drift
        days, low, high = parameter_band(drift, parameter, followed.loop.outcomes, hours[-1])
        axis.fill_between(days, low, high, color=GREEN, alpha=0.25, linewidth=0, label="policy")
        days, low, high = parameter_band(drift, parameter, followed.track.outcomes, hours[-1])
        axis.plot(days, low, "--", color=PURPLE, linewidth=0.8, label="filter, the same sweeps")
        axis.plot(days, high, "--", color=PURPLE, linewidth=0.8)
        axis.plot(hours / 24.0, true, color=BLACK, linewidth=1, label="truth")
        for kind, colour, marker in (("all", BLUE, "o"), ("extrinsic", VERMILION, "s")):
            chosen = [s for s in SESSIONS if s.free == kind]
            shown = [week.identifications[s.name].estimate.shown()[parameter.name] for s in chosen]
            at, values = [s.day for s in chosen], [entry["value"] for entry in shown]
            sds = [2 * entry["sd"] for entry in shown]
            label = "full identification" if kind == "all" else "extrinsic only, day-2 intrinsics"
            style = {"fmt": marker, "color": colour, "markersize": 4, "capsize": 3, "linewidth": 1}
            axis.errorbar(at, values, sds, label=label, **style)
        axis.set_ylabel(parameter.latex)
        axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("time [days]")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9
    )
    return figure


#: From dark to light in any print and for any eye; its yellow end is too pale for a line.
_SEQUENCE = colormaps["viridis"]
_PALEST = 0.9


def draw_circles(checks: Sequence[Circle], renewed: Sequence[Circle]) -> Figure:
    """Draw the change of cavity length and the irradiance along each circle.

    `checks` are made with the estimate of day 0, one after the other; the names of those `renewed` at an identification
    begin with ``before-`` or ``after-``.
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
    for i, (check, colour, (phase, irradiance)) in enumerate(zip(checks, colours, recorded, strict=True)):
        name = f"{check.time_h:g} h: {1e3 * check.peak_to_peak:.0f} nm"
        length.plot(check.phase, 1e3 * check.change, color=colour, label=name)
        # Checks start on a rising or a falling flank of a fringe, whichever is nearer.
        shifted = irradiance - irradiance[0] + i * step
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
        for when, colour, style in (("before", VERMILION, "--"), ("after", BLUE, "-")):
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


def _along_path(circle: Circle) -> tuple[Floats, Floats]:
    """Phase in deg and irradiance of the samples of the path itself."""
    path = circle.trace.path
    time = circle.trace.time_s[path]
    share = (time - time[0]) / (time[-1] - time[0])
    return np.interp(share, np.linspace(0.0, 1.0, len(circle.phase)), circle.phase), circle.trace.irradiance[path]


def _label(axis: Axes, y: str) -> None:
    axis.set(xlabel="phase on the circle [deg]", ylabel=y, xlim=(0, 360), xticks=(0, 90, 180, 270, 360))
    axis.grid(alpha=0.3)


#: Line styles tell them apart in grey print.
_STYLES = ((VERMILION, "-"), (SKY, "--"), (BLUE, "-"))


def draw_courses(courses: Sequence[Scenario]) -> Figure:
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
