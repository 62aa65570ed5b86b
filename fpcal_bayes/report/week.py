"""The paper's week as tables and figures: parameters beside the truth, circles, and what each way through it costs."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.report.pages import BLUE, SKY, VERMILION
from fpcal_bayes.report.table import Table, TableCell, number, plain_table
from fpcal_bayes.study.paper_scenarios import Scenario
from fpcal_bayes.study.paper_week import Circle


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


def draw_courses(courses: Sequence[Scenario]) -> Figure:
    """Draw the error at each time above, the number of sweeps spent after day 0 below."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    error, spent = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    # Line styles tell them apart in grey print.
    for course, (colour, style) in zip(courses, ((VERMILION, "-"), (SKY, "--"), (BLUE, "-")), strict=True):
        text = f"{course.name}: {100 * course.share:.1f} % of the time in tolerance, {counted(course.spent, 'sweep')}"
        error.plot(course.times_h / 24.0, 1e3 * course.peaks, style, color=colour, linewidth=0.9, label=text)
        days = np.append(course.session_h, course.times_h[-1]) / 24.0
        total = np.cumsum(np.append(0, course.session_sweeps[1:]))
        spent.step(days, np.append(total, total[-1]), style, where="post", color=colour, linewidth=1.2)
    tolerance = 1e3 * courses[0].tolerance
    error.axhline(tolerance, color="black", linewidth=0.8, linestyle=":", label=f"tolerance {tolerance:g} nm")
    least = 0.8e3 * min(float(course.peaks.min()) for course in courses)
    error.set(yscale="log", ylim=(least, None), ylabel="error of the circle, peak to peak [nm]")
    error.yaxis.set_major_formatter("{x:g}")
    error.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))
    spent.set(xlabel="time [days]", ylabel="sweeps after day 0", xlim=(0, courses[0].times_h[-1] / 24.0))
    for axis in (error, spent):
        axis.grid(alpha=0.3)
    figure.legend(loc="outside upper center", fontsize=8, frameon=False)
    return figure
