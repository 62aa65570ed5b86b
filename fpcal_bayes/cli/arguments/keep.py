"""Options of the commands that keep a cell calibrated, drive it, and simulate weeks of it."""

from argparse import ArgumentParser, BooleanOptionalAction
from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, Folder, add_costs, add_goal, count, positive, seed

_NOW = "for which time (default: this clock where rows carry utc, else the last session)"


def _plan(parser: ArgumentParser) -> None:
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
    add("--midpoints", action=BooleanOptionalAction, default=True, help="read each sweep at its middle too")
    add("--readings", type=seed, metavar="K", help="of a sweep after its start, evenly spaced; 0: the whole trace")
    add("--absolute", action="store_true", help="suppose one absolute length, known to lambda/8")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    add("--candidates", type=count, default=2000, metavar="N", help="to choose from (default: 2000)")
    add("--draws", type=count, metavar="N", help="of the prior (default: 192; with mechanics 24)")
    add("--max-tilt-deg", type=positive, default=4.3, metavar="A", help="of mirror against light (default: 4.3)")
    add("--max-fringe-rate", type=positive, default=1000.0, metavar="HZ", help="that is counted (default: 1000)")
    add("--coordinated", action=BooleanOptionalAction, help="joints of one controller may move together")
    add("--single-joints", dest="coordinated", action="store_const", const=False, help="as --no-coordinated")
    add("--seed", type=seed, default=0, help="of the search (default: 0)")
    add("--rows", metavar="OUT", type=Path, help="write the readings as rows: .csv or .h5")
    add("--figure", metavar="OUT", type=Path, help="draw the plan: .svg or .png")
    add("--frontier", metavar="OUT", type=Path, help="draw accuracy against sweeps and minutes: .svg or .png")


def _track(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add("--estimate", metavar="OUT", type=Path, help="write the current best estimate as JSON")
    flat = "write it flat for MATLAB or LabVIEW: .json or .mat, with fpcal_ik.m and fpcal_fk.m beside it"
    add("--flat", metavar="OUT", type=Path, help=flat)
    add("--now", metavar="TIME_H|UTC", help="refuse sessions after this time (default: this clock)")
    add_goal(parser)
    add("--anew", action="store_true", help="take in all sessions again, whatever was saved")
    add("--watch", metavar="SECONDS", type=positive, help="look again so often, take in what is new, until interrupted")
    add("--fit-drift", action="store_true", help="say which drift sizes the sessions support, beside those of the cell")
    add("-o", "--output", metavar="CELL.toml", type=Path, help="with --fit-drift: write the cell with these sizes")
    add("--force", action="store_true", help="write over CELL.toml")


def _decide(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add_goal(parser)
    add("--now", metavar="TIME_H|UTC", help=_NOW)
    add_costs(parser)
    add("-o", dest="output", metavar="TICKET.csv", type=Path, help="write what to measure; on hold a header alone")


def _append(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", type=Path, help="HDF5 campaign, or CSV")
    add("measured", metavar="MEASURED", help="sweeps of the new session: CSV or HDF5")
    add("--ticket", metavar="TICKET.csv", help="what was to be measured, of fpcal decide")


def _keep(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add("--ticket", metavar="TICKET.csv", type=Path, required=True, help="what to measure now, or a header alone")
    add("--estimate", metavar="E", type=Path, required=True, help="the current best estimate, JSON")
    add("--flat", metavar="OUT", type=Path, help="the same flat, for MATLAB or LabVIEW: .json or .mat")
    add("--report", metavar="R.html", type=Path, help="the campaign's page")
    add("--rig", metavar="RIG", help="measure tickets on the live cell: RIG.toml")
    add("--every-min", type=positive, default=15.0, metavar="MIN", help="most between two decisions (default: 15)")
    add("--look-s", type=positive, default=5.0, metavar="S", help="time between two looks at the campaign (default: 5)")
    add("--once", action="store_true", help="one round, then end")
    add_goal(parser)
    add_costs(parser)


def _export(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("file", metavar="PLAN|JOINTS", help="plan or ticket (CSV), or joint path of fpcal control -o (CSV)")
    add("-o", dest="output", metavar="MOVES", type=Path, required=True, help="moves to write: .csv or .mat")


def _import(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("log", metavar="LOG", help="moves: .csv or .mat")
    add("-o", dest="output", metavar="SWEEPS", type=Path, required=True, help="sweeps to write: .csv or .h5")
    add("--session", default="session-1", metavar="NAME", help="where the log does not say (default: session-1)")
    add("--time-h", type=float, default=0.0, metavar="H", help="of the first move, likewise (default: 0)")


def _measure(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("ticket", metavar="TICKET", help="ticket or plan: CSV without measured values")
    add("--rig", metavar="RIG", required=True, help="devices: RIG.toml")
    add("-o", dest="output", metavar="SESSION", type=Path, required=True, help="session to write: .h5 or .csv")
    add("--campaign", metavar="C", help="campaign that the session will belong to: its clock, its past")
    add("--estimate", metavar="ESTIMATE", help="geometry that tells the gap (default: the nominal one)")
    add("--dry-run", action="store_true", help="look at every move and make none")


def _rig(parser: ArgumentParser) -> None:
    parser.add_argument("--emulate", metavar="RIG", required=True, help="devices to emulate: RIG.toml")
    written = "rig file to write (default: RIG_live.toml)"
    parser.add_argument("-o", dest="output", metavar="LIVE", type=Path, help=written)


def _serve(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("--campaign", metavar="C", type=Path, required=True, help="campaign that sweeps are added to: HDF5 or CSV")
    add("--estimate", metavar="E", required=True, help="the current best estimate, which fpcal keep replaces")
    add("--ticket", metavar="TICKET.csv", type=Path, help="what was to be measured: sweeps keep to it, and empty it")
    add("--host", default="127.0.0.1", metavar="ADDRESS", help="to listen on (default: 127.0.0.1)")
    add("--port", type=count, default=8765, metavar="P", help="to listen on (default: 8765)")
    add("--token", metavar="FILE", help="text of 16 characters or more that every request must carry")
    add("--rig", metavar="RIG", help="take the time from this rig, as fpcal keep --rig does: RIG.toml")
    add_goal(parser)
    add_costs(parser)


def _report(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add("-o", dest="output", metavar="REPORT.html", type=Path, required=True, help="the page")
    add("--posterior", metavar="POSTERIOR.nc", help="draws of the first session, of fpcal sample")
    add("--verification", metavar="VERIFIED.json", help="of the first session, of fpcal verify or identify --hold-out")
    add_goal(parser)
    add("--now", metavar="TIME_H|UTC", help=_NOW)


def _week(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("-o", dest="output", metavar="DIR", type=Folder, default=Folder("week"), help="folder (default: week)")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    add("--seed", type=seed, default=0, help="of the noise (default: 0)")
    add("--no-page", dest="page", action="store_false", help="leave out report.html")


def _study(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("study", metavar="NAME", choices=("coverage", "sbc"), help="coverage or sbc")
    add("--replicates", type=count, required=True, metavar="N", help="how many in all")
    add("-o", dest="output", metavar="STORE", type=Path, help="store (default: study-NAME.jsonl)")
    add("--anew", action="store_true", help="forget what the store holds")
    add("--workers", type=count, metavar="N", help="processes of this machine (default: its cores)")
    add("--seed", type=seed, default=0, help="of the study (default: 0)")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    add("--protocol", default="paper", metavar="paper|paper-mid|SWEEPS", help="to calibrate with; sbc also: random")
    add("--draws", type=count, default=400, help="sbc: effective draws of a posterior (default: 400)")


#: Names, summaries and options, in the order of the work.
COMMANDS: Commands = (
    ("plan", "choose which sweeps to measure", _plan),
    ("track", "follow the parameters from session to session", _track),
    ("decide", "decide whether to measure now, and what", _decide),
    ("append", "add a measured session to a campaign", _append),
    ("keep", "keep a cell calibrated: track, decide, publish, again and again", _keep),
    ("export", "write a plan or joint path as moves of the controllers", _export),
    ("import", "read what the controllers logged as sweeps", _import),
    ("measure", "drive a ticket on the live cell", _measure),
    ("rig", "emulate the devices of a cell", _rig),
    ("serve", "answer controllers over HTTP from the current best estimate", _serve),
    ("report", "write a campaign's report as one HTML page", _report),
    ("week", "run the paper's week on a simulated cell", _week),
    ("study", "run many independent replicates of a question", _study),
)
