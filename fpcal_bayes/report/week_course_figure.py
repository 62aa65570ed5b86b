"""Error of the circle through the week and sweeps spent, by the paper's protocol, the filter and the policy."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.week_courses import Course

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
