"""Options that say what the cell must hold."""

import argparse
from typing import TYPE_CHECKING

from fpcal_bayes.cli.common import positive, share

if TYPE_CHECKING:
    from fpcal_bayes.track.horizon import Goal


def add_goal(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what the cell must hold."""
    parser.add_argument(
        "--tolerance-nm", type=positive, default=50.0, help="largest peak to peak of a task's error (default: 50)"
    )
    parser.add_argument(
        "--task", metavar="TASK", action="append", help="to be held: circle (default), line-x, line-z, tilt-x, tilt-z, "
        "spin, or PATH.csv; may be given several times"
    )  # fmt: skip
    parser.add_argument("--radius-um", type=positive, default=100.0, help="of the circle (default: 100)")
    parser.add_argument("--level", type=share, default=0.1, help="accepted probability (default: 0.1)")


def goal_of(options: argparse.Namespace) -> "Goal":
    """The goal that the options name."""
    # What the goal stands in needs numpy and scipy: loaded only when a command runs.
    from fpcal_bayes.track.horizon import Goal

    tasks = tuple(dict.fromkeys(options.task or ["circle"]))
    return Goal(1e-3 * options.tolerance_nm, tasks, options.level, options.radius_um)
