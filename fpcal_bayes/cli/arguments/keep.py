"""Options of the commands that keep a cell calibrated, and of those that simulate weeks of it."""

import argparse
from pathlib import Path

from fpcal_bayes.cli.arguments.common import (
    Commands,
    Folder,
    add_command,
    add_costs,
    add_goal,
    add_json,
    count,
    positive,
    seed,
)

_PLAN = """\
Sweeps are chosen such that the worst task, in units of what the paper's 69 sweeps leave, is expected to be known best.
The search starts at many places among random candidates; the best of them descend together to where the criterion is
smallest nearby. One joint moves at a time; with --coordinated, or where the cell's envelope lets axes move together,
several joints of one controller also do, and both kinds of plan are compared.
Without an estimate the plan is averaged over draws of the prior, and judged on others that it is not made for. With
mechanics the error motions that the cell states count, in the sweeps and in what they leave of the tasks.

--reach tilt-x=5nm,circle=1nm asks for the fewest sweeps that are expected to reach these standard deviations at each
task's worst point, --minutes M for the most sweeps in that time, --frontier for a picture of both.
--for extrinsic plans a re-identification: --estimate says what is known, --hours how long ago. --after FILE are sweeps
that come first: measured ones are identified, and the plan holds the best next sweeps; with --reach it holds none, and
should_stop is true in the JSON, once the targets are reached.

--commission writes small safe moves around joint zero for a new cell: once they are measured, fpcal doctor says which
axis counts the other way, is swapped with another, or stands in another unit, and what to look at: lengths cannot tell
the cell from its mirror images.

SWEEPS holds whole sweeps with the column `readings`, which every command that takes a plan obeys. --rows writes the
readings of each as rows of one group, for other programs.
Criteria: worst (task), I (mean over tasks), A, D, E (of the parameters), O1 (observability index).
"""


def plan(commands: Commands) -> None:
    """Add ``fpcal plan``."""
    parser = add_command(commands, "plan", "choose which sweeps to measure", _PLAN)
    add = parser.add_argument
    add("-o", dest="output", metavar="SWEEPS", type=Path, required=True, help="plan to write: .csv or .h5")
    add("--n", type=count, metavar="N", help="number of sweeps (with --reach: at most)")
    add("--reach", metavar="TASK=NM,..", help="fewest sweeps that reach these standard deviations")
    add("--minutes", type=positive, metavar="M", help="most sweeps that take no longer")
    add("--commission", action="store_true", help="small moves that tell how the axes of a new cell are connected")
    add("--validation", type=count, metavar="N", help="sweeps that verify the calibration of --after: fpcal verify")
    add("--tasks", metavar="TASK,..", help="tasks that count (default: circle,tilt-x,tilt-z,spin)")
    add("--radius-um", type=positive, metavar="R", help="of the circle (default: 100, or as limits allow)")
    add("--for", dest="purpose", choices=("full", "extrinsic"), default="full", help="calibration or re-identification")
    add("--estimate", metavar="ESTIMATE", help="with --for extrinsic: what is known")
    add("--hours", type=positive, metavar="H", help="with --for extrinsic: drift since (default: 24)")
    add("--after", metavar="FILE", help="sweeps, measured or planned, that come first")
    add("--session", metavar="NAME", help="session of these (default: the first)")
    add("--midpoints", action=argparse.BooleanOptionalAction, default=True, help="read each sweep at its middle too")
    add("--readings", type=seed, metavar="K", help="of a sweep after its start, evenly spaced; 0: the whole trace")
    add("--absolute", action="store_true", help="suppose one absolute length, known to lambda/8")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    add("--criterion", choices=("worst", "I", "A", "D", "E", "O1"), default="worst", help="see below (default: worst)")
    add("--candidates", type=count, default=2000, metavar="N", help="to choose from (default: 2000)")
    add("--draws", type=count, metavar="N", help="of the prior (default: 192; with mechanics 24)")
    add("--max-tilt-deg", type=positive, metavar="A", help="of mirror against light (default: 4.3)")
    add("--max-fringe-rate", type=positive, metavar="HZ", help="that is counted (default: 1000)")
    add("--coordinated", action=argparse.BooleanOptionalAction, help="joints of one controller may move together")
    add("--single-joints", dest="coordinated", action="store_const", const=False, help="as --no-coordinated")
    add("--seed", type=seed, default=0, help="of the search (default: 0)")
    add("--rows", metavar="OUT", type=Path, help="write the readings as rows: .csv or .h5")
    add("--figure", metavar="OUT", type=Path, help="draw the plan: .svg or .png")
    add("--frontier", metavar="OUT", type=Path, help="draw accuracy against sweeps and minutes: .svg or .png")
    add_json(parser)


_TRACK = """\
The first session of CAMPAIGN is the full calibration, the following ones update it: any number of sweeps, at any time.
Sessions may stand in any order; one that arrives late takes its place. In an HDF5 campaign the states are saved, and
the next run takes in what is new; a CSV is never changed.

Verdict of a session: as-modelled; extrinsics-moved (mirror or fibre moved more than their drift: their uncertainty is
widened and the session taken in anew); intrinsics-moved (the robot itself changed: a full calibration is due);
mechanics-moved (the error motions of its joints changed: the same). With mechanics the error motions are followed too.

ESTIMATE is replaced as a whole, so a controller may read it at any time; with --watch that happens after every new
session. It holds until the probability that a task's error passes the tolerance reaches the level (valid_until_h);
fpcal decide says what to do then.
"""


def track(commands: Commands) -> None:
    """Add ``fpcal track``."""
    parser = add_command(commands, "track", "follow the parameters from session to session", _TRACK)
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add("--estimate", metavar="OUT", type=Path, help="write the current best estimate as JSON")
    add(
        "--flat", metavar="OUT", type=Path, help="write it flat for MATLAB or LabVIEW: .json or .mat, with fpcal_ik.m "
        "and fpcal_fk.m beside it"
    )  # fmt: skip
    add("--now", metavar="TIME_H|UTC", help="refuse sessions after this time (default: this clock)")
    add_goal(parser)
    add("--anew", action="store_true", help="take in all sessions again, whatever was saved")
    add("--watch", metavar="SECONDS", type=positive, help="look again so often, take in what is new, until interrupted")
    add("--fit-drift", action="store_true", help="say which drift sizes the sessions support, beside those of the cell")
    add("-o", "--output", metavar="CELL.toml", type=Path, help="with --fit-drift: write the cell with these sizes")
    add("--force", action="store_true", help="write over CELL.toml")
    add_json(parser)


_DECIDE = """\
hold: nothing is to be measured before the time that is said; extrinsic: a few sweeps now, chosen to leave the least
error of the tasks; full: calibrate in full, since the robot itself moved or no few sweeps reach the tolerance.

The error of a task is what the controller does not know of the cavity length along its path, peak to peak. LEVEL is the
probability of being out of tolerance that is accepted before the next measurement; the share of time spent outside is
about a third of it.
"""


def decide(commands: Commands) -> None:
    """Add ``fpcal decide``."""
    parser = add_command(commands, "decide", "decide whether to measure now, and what", _DECIDE)
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add_goal(parser)
    add(
        "--now", metavar="TIME_H|UTC", help="time of the decision (default: this clock where rows carry utc, else the "
        "last session)"
    )  # fmt: skip
    add_costs(parser)
    add("-o", dest="output", metavar="TICKET.csv", type=Path, help="write what to measure; on hold a header alone")
    add_json(parser)


_KEEP = """\
Does what `fpcal track`, `fpcal decide` and `fpcal report` do, again whenever CAMPAIGN has changed and every MIN
minutes: estimate and ticket are replaced in one step, states are saved in an HDF5 campaign. Whoever measures does so
when TICKET has rows, and hands over by `fpcal append CAMPAIGN SESSION --ticket TICKET`, which empties the ticket. A
ticket that is being measured stays as it is until its session has come, or it expires. Where the campaign cannot be
read or the tolerance cannot be met the ticket is emptied. Whatever is in the way is said once and waited for. Rows need
no clock times: the clock runs on from when a session was first seen.

--rig measures each ticket on the live cell and hands it over. Ends with Ctrl-C.
"""


def keep(commands: Commands) -> None:
    """Add ``fpcal keep``."""
    parser = add_command(commands, "keep", "keep a cell calibrated: track, decide, publish, again and again", _KEEP)
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add("--ticket", metavar="TICKET.csv", type=Path, required=True, help="what to measure now, or a header alone")
    add("--estimate", metavar="E", type=Path, required=True, help="the current best estimate, JSON")
    add("--flat", metavar="OUT", type=Path, help="the same flat, for MATLAB or LabVIEW: .json or .mat")
    add("--report", metavar="R.html", type=Path, help="the campaign's page")
    add("--rig", metavar="RIG", help="measure tickets on the live cell: RIG.toml")
    add(
        "--every-min",
        type=positive,
        default=15.0,
        metavar="MIN",
        help="longest time between two decisions (default: 15)",
    )
    add("--look-s", type=positive, default=5.0, metavar="S", help="time between two looks at the campaign (default: 5)")
    add("--once", action="store_true", help="one round, then end")
    add_goal(parser)
    add_costs(parser)


_APPEND = """\
MEASURED holds sessions that CAMPAIGN does not hold yet, CSV or HDF5; what it holds stands where it was. With --ticket
every row must be one that the ticket asks for, under the ticket's session name and before it expires. A ticket without
rows asks for nothing, and nothing is done. A row that is there already, a session that begins before another one ends,
or clock times that contradict `time_h` are refused, and CAMPAIGN stays as it was.
"""


def append(commands: Commands) -> None:
    """Add ``fpcal append``."""
    parser = add_command(commands, "append", "add a measured session to a campaign", _APPEND)
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", type=Path, help="HDF5 campaign, or CSV")
    add("measured", metavar="MEASURED", help="sweeps of the new session: CSV or HDF5")
    add("--ticket", metavar="TICKET.csv", help="what was to be measured, of fpcal decide")
    add_json(parser)


_EXPORT = """\
MOVES has a row per axis and pose, in the controllers' own names, channels, units, signs and zeros as the cell states
them: move, controller, channel, unit, position, and speed, dwell_s, reading. Rows of one move are driven in order,
in step where in_step is 1. `fpcal import` reads such a file, or a log with the columns
move,controller,channel,unit,position,utc and, if the length was read there, length_um and sigma_um (of the
change).
"""


def export(commands: Commands) -> None:
    """Add ``fpcal export``."""
    parser = add_command(commands, "export", "write a plan or joint path as moves of the controllers", _EXPORT)
    add = parser.add_argument
    add("file", metavar="PLAN|JOINTS", help="plan or ticket (CSV), or joint path of fpcal control -o (CSV)")
    add("-o", dest="output", metavar="MOVES", type=Path, required=True, help="moves to write: .csv or .mat")


_IMPORT = """\
LOG has the columns move,controller,channel,unit,position and, if known, utc, reading, length_um, sigma_um, as `fpcal
export` explains. Without `reading`, moves 1 and 2, 3 and 4 and so on are start and end of sweeps. Where lengths were
read SWEEPS is measured, else a plan of what was driven.
"""


def import_(commands: Commands) -> None:
    """Add ``fpcal import``."""
    parser = add_command(commands, "import", "read what the controllers logged as sweeps", _IMPORT)
    add = parser.add_argument
    add("log", metavar="LOG", help="moves: .csv or .mat")
    add("-o", dest="output", metavar="SWEEPS", type=Path, required=True, help="sweeps to write: .csv or .h5")
    add("--session", default="session-1", metavar="NAME", help="where the log does not say (default: session-1)")
    add("--time-h", type=float, default=0.0, metavar="H", help="of the first move, likewise (default: 0)")


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
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add("-o", dest="output", metavar="REPORT.html", type=Path, required=True, help="the page")
    add("--posterior", metavar="POSTERIOR.nc", help="draws of the first session, of fpcal sample")
    add_goal(parser)
    add(
        "--now", metavar="TIME_H|UTC", help="time of the report (default: this clock where rows carry utc, else the "
        "last session)"
    )  # fmt: skip
    add_json(parser)


_WEEK = """\
The truth goes through the paper's tables on days 0, 1, 2 and 8. It is lived through three times: by the paper's
protocol (69 sweeps on days 0, 1, 2, 7 and 8, the extrinsic parameters alone on day 7), by a filter that takes in the
same sweeps, and under the policy of fpcal decide, which holds a circle of 100 um radius within 50 nm
(a machine that cannot meet that: one and a half times the least that it can).

Writes into DIR: campaign.h5 (sweeps of the paper's protocol, truth, an estimate a session, and the filter's track),
policy.h5 (day 0 and the policy's sweeps, truth, its track and decisions), an estimate JSON a session, estimate.json
(the policy's last), report.html (fpcal report of campaign.h5), report.txt (the paper's Tables II to VII anew beside the
truth, circles, what each way held and cost, and the posterior of day 0), posterior.nc (its draws), circles/ (the
irradiance along each circle, for fpcal check), extrinsics.svg, circles.svg, courses.svg.
"""


def week(commands: Commands) -> None:
    """Add ``fpcal week``."""
    parser = add_command(commands, "week", "run the paper's week on a simulated cell", _WEEK)
    add = parser.add_argument
    add("-o", dest="output", metavar="DIR", type=Folder, default=Folder("week"), help="folder (default: week)")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    add("--seed", type=seed, default=0, help="of the noise (default: 0)")
    add(
        "--between", choices=("steady", "walk"), default="steady", help="how the truth gets from one of the paper's "
        "tables to the next: steadily, or on a random walk with the cell's drift sizes (default: steady)"
    )  # fmt: skip
    add("--no-page", dest="page", action="store_false", help="leave out report.html")


_STUDY = """\
coverage  does the truth lie in the predicted bands of each task?
sbc       simulation-based calibration: are the truths uniformly ranked among posterior draws?

Replicate K is the same whenever it runs. Each is put into STORE, a line of JSON, as soon as it is there. A study that
was stopped, or killed, goes on when the command is given again, and leaves the same file byte for byte; a larger
--replicates adds to it.
"""


def study(commands: Commands) -> None:
    """Add ``fpcal study``."""
    parser = add_command(commands, "study", "run many independent replicates of a question", _STUDY)
    add = parser.add_argument
    add("study", metavar="NAME", choices=("coverage", "sbc"), help="coverage or sbc")
    add("--replicates", type=count, required=True, metavar="N", help="how many in all")
    add("-o", dest="output", metavar="STORE", type=Path, help="store (default: study-NAME.jsonl)")
    add("--anew", action="store_true", help="forget what the store holds")
    add("--workers", type=count, metavar="N", help="processes of this machine (default: its cores)")
    add("--seed", type=seed, default=0, help="of the study (default: 0)")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    add(
        "--protocol", default="paper", metavar="paper|paper-mid|SWEEPS",
        help="sweeps of each calibration (default: paper); sbc also: random"
    )  # fmt: skip
    add("--draws", type=count, default=400, help="sbc: effective draws of a posterior (default: 400)")
    add_json(parser)
