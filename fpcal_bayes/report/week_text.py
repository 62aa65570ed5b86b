"""Circles and courses of the week as tables."""

from collections.abc import Sequence

from rich.table import Table

from fpcal_bayes.report.tables import plain_table
from fpcal_bayes.week_circle import Circle
from fpcal_bayes.week_courses import Course


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
