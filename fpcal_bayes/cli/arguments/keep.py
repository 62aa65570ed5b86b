"""Options of the commands that keep a cell calibrated."""

import argparse
from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, add_command, add_goal, add_json, count, positive, seed

_PLAN = """\
Sweeps are chosen among random candidates, one joint or several joints of one controller moving, such that the worst
task, in units of what the paper's 69 sweeps leave, is expected to be known best; then they are varied to serve better,
and at the end all of them move together to where the criterion is smallest nearby.
Without an estimate the plan is averaged over draws of the prior, so that it is good before the cell is known.

--reach tilt-x=5nm,circle=1nm asks for the fewest sweeps that are expected to reach these standard deviations at each
task's worst point. --for extrinsic plans a re-identification: --estimate says what is known, --hours how long ago.
--after FILE are sweeps that come first: measured ones are identified, and the plan holds the best next sweeps.

SWEEPS holds whole sweeps. --rows writes the readings of each as rows of one group, for `fpcal simulate --protocol`.
Criteria: worst (task), I (mean over tasks), A, D, E (of the parameters), O1 (observability index).
"""


def plan(commands: Commands) -> None:
    """Add ``fpcal plan``."""
    parser = add_command(commands, "plan", "choose which sweeps to measure", _PLAN)
    parser.add_argument(
        "-o", dest="output", metavar="SWEEPS", type=Path, required=True, help="plan to write: .csv or .h5"
    )
    parser.add_argument("--n", type=count, metavar="N", help="number of sweeps (with --reach: at most)")
    parser.add_argument("--reach", metavar="TASK=NM,..", help="fewest sweeps that reach these standard deviations")
    parser.add_argument("--tasks", metavar="TASK,..", help="tasks that count (default: circle,tilt-x,tilt-z,spin)")
    parser.add_argument("--radius-um", type=positive, default=100.0, metavar="R", help="of the circle (default: 100)")
    parser.add_argument(
        "--for", dest="purpose", choices=("full", "extrinsic"), default="full", help="calibration or re-identification"
    )
    parser.add_argument("--estimate", metavar="ESTIMATE", help="with --for extrinsic: what is known")
    parser.add_argument("--hours", type=positive, metavar="H", help="with --for extrinsic: drift since (default: 24)")
    parser.add_argument("--after", metavar="FILE", help="sweeps, measured or planned, that come first")
    parser.add_argument("--session", metavar="NAME", help="session of these (default: the first)")
    parser.add_argument(
        "--midpoints", action=argparse.BooleanOptionalAction, default=True, help="read each sweep at its middle too"
    )
    parser.add_argument(
        "--readings", type=count, metavar="K", help="readings of a sweep after its start, evenly spaced"
    )
    parser.add_argument("--absolute", action="store_true", help="suppose one absolute length, known to lambda/8")
    parser.add_argument("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    parser.add_argument(
        "--criterion", choices=("worst", "I", "A", "D", "E", "O1"), default="worst", help="see below (default: worst)"
    )
    parser.add_argument("--candidates", type=count, default=2000, metavar="N", help="to choose from (default: 2000)")
    parser.add_argument("--draws", type=count, default=64, metavar="N", help="of the prior (default: 64)")
    parser.add_argument("--max-tilt-deg", type=positive, metavar="A", help="of mirror against light (default: 4.3)")
    parser.add_argument("--max-fringe-rate", type=positive, metavar="HZ", help="that is counted (default: 1000)")
    parser.add_argument("--single-joints", action="store_true", help="move one joint at a time only")
    parser.add_argument(
        "--variations", type=count, default=30, metavar="N", help="of each sweep in a round of refinement (default: 30)"
    )
    parser.add_argument("--seed", type=seed, default=0, help="of the search (default: 0)")
    parser.add_argument("--rows", metavar="OUT", type=Path, help="write the readings as rows: .csv or .h5")
    parser.add_argument("--figure", metavar="OUT", type=Path, help="draw the plan: .svg or .png")
    add_json(parser)


_TRACK = """\
The first session of CAMPAIGN is the full calibration, the following ones update it: any number of sweeps, at any time.
Sessions may stand in any order; one that arrives late takes its place. In an HDF5 campaign the states are saved, and
the next run takes in what is new; a CSV is never changed.

Verdict of a session: as-modelled; extrinsics-moved (mirror or fibre moved more than their drift: their uncertainty is
widened and the session taken in anew); intrinsics-moved (the robot itself changed: a full calibration is due).

ESTIMATE is replaced as a whole, so a controller may read it at any time; with --watch that happens after every new
session. It holds until the probability that a task's error passes the tolerance reaches the level (valid_until_h);
fpcal decide says what to do then.
"""


def track(commands: Commands) -> None:
    """Add ``fpcal track``."""
    parser = add_command(commands, "track", "follow the parameters from session to session", _TRACK)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    parser.add_argument("--estimate", metavar="OUT", type=Path, help="write the current best estimate as JSON")
    parser.add_argument("--now", metavar="TIME_H|UTC", help="refuse sessions after this time (default: this clock)")
    parser.add_argument(
        "--posterior", metavar="POSTERIOR.nc", help="start from these draws of the first session's posterior (fpcal "
        "sample) in place of a few that are made here; takes in all sessions again"
    )  # fmt: skip
    add_goal(parser)
    parser.add_argument("--anew", action="store_true", help="take in all sessions again, whatever was saved")
    parser.add_argument(
        "--watch", metavar="SECONDS", type=positive, help="look again so often, take in what is new, until interrupted"
    )
    add_json(parser)


_DECIDE = """\
hold: nothing is to be measured before the time that is said; extrinsic: a few sweeps now, chosen to leave the least
error of the tasks; full: calibrate in full, since the robot itself moved or no few sweeps reach the tolerance.

The error of a task is what the controller does not know of the cavity length along its path, peak to peak. LEVEL is the
probability of being out of tolerance that is accepted before the next measurement; the share of time spent outside is
about a third of it. With --cost-out the level is the one at which measuring and errors together cost least.
"""


def decide(commands: Commands) -> None:
    """Add ``fpcal decide``."""
    parser = add_command(commands, "decide", "decide whether to measure now, and what", _DECIDE)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add_goal(parser)
    parser.add_argument(
        "--now", metavar="TIME_H|UTC", help="time of the decision (default: this clock where rows carry utc, else the "
        "last session)"
    )  # fmt: skip
    parser.add_argument("--horizon-h", type=positive, default=24.0, help="how far to look ahead (default: 24)")
    parser.add_argument("--minutes-per-sweep", type=positive, default=2.0, help="default: 2")
    parser.add_argument("--minutes-per-session", type=positive, help="spent once a session (default: none)")
    parser.add_argument(
        "--cost-out", type=positive, metavar="MINUTES", help="of measuring that an hour out of tolerance is worth"
    )
    parser.add_argument("--most-sweeps", type=count, default=6, help="of a session with few sweeps (default: 6)")
    parser.add_argument(
        "--least-sweeps", type=count, default=1, help="of such a session: 2 for a circle whose drift sizes are not to "
        "be trusted (default: 1)"
    )  # fmt: skip
    parser.add_argument(
        "--diagnose-every-h", type=positive, default=24.0, metavar="H", help="longest time between two sessions that "
        "can show a change of the robot itself (default: 24)"
    )  # fmt: skip
    parser.add_argument("--sigma-nm", type=positive, help="of the sweeps to come (default: the campaign's median)")
    parser.add_argument("-o", dest="output", metavar="SWEEPS.csv", type=Path, help="write the sweeps as a plan")
    add_json(parser)


_REPORT = """\
The page holds the verdict (hold, re-identify, recalibrate), the error of each task against the tolerance, parameters
with intervals, what the calibration can tell, residuals, drift with alarms, the log of all sessions, an uncertainty
budget and where every number comes from. It needs no network, and prints well.

A calibration that did not converge or does not fit is said to be of no use; the exit status is then 1. The numbers of
the page are those of fpcal track, decide, task-error and observe with the same options.
"""


def report(commands: Commands) -> None:
    """Add ``fpcal report``."""
    parser = add_command(commands, "report", "write a campaign's report as one HTML page", _REPORT)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    parser.add_argument("-o", dest="output", metavar="REPORT.html", type=Path, required=True, help="the page")
    parser.add_argument("--posterior", metavar="POSTERIOR.nc", help="draws of the first session, of fpcal sample")
    add_goal(parser)
    parser.add_argument(
        "--now", metavar="TIME_H|UTC", help="time of the report (default: this clock where rows carry utc, else the "
        "last session)"
    )  # fmt: skip
    add_json(parser)
