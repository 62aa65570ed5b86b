"""Options of the commands that find the parameters of a cell, and of those that use them."""

from argparse import ArgumentParser
from pathlib import Path

from fpcal_bayes.cli.arguments.common import (
    Commands,
    Folder,
    add_command,
    add_json,
    add_prior,
    add_task_options,
    count,
    positive,
    seed,
    share,
)

_IDENTIFY = """\
--free takes groups and names, for example `--free extrinsic` or `--free all,gain_4`. Parameters that are not free are
held at --start (or at nominal), and their uncertainty reaches the result; --hold exact takes them as known.

Status of a parameter: identified (the data tell it); weak (the data halve its prior variance at best); gauge (the data
see it only together with others: its value is the prior's); fixed (held).
"""


_TRACES = "take every sample of recorded traces in place of rows (FILE: what fpcal ingest reads or made)"


def _add_sweeps(parser: ArgumentParser) -> None:
    sessions = "session to use, or several of an unchanged cell: a,b (default: the first)"
    parser.add_argument("file", metavar="FILE", help="sweeps: CSV, or HDF5 campaign")
    parser.add_argument("--session", metavar="NAME", help=sessions)


def identify(commands: Commands) -> None:
    """Add ``fpcal identify``."""
    parser = add_command(commands, "identify", "find the parameters of a cell from sweeps", _IDENTIFY)
    add = parser.add_argument
    _add_sweeps(parser)
    add("--free", default="all", metavar="all|intrinsic|extrinsic|NAME,..", help="what to identify")
    add("--start", metavar="ESTIMATE", help="estimate JSON to start from and to hold the rest at")
    add_prior(parser)
    add("--hold-out", type=share, metavar="SHARE", help="leave this share of the sweeps out, and verify with them")
    add("--hold", choices=("consider", "exact"), default="consider", help="how to hold the rest")
    add("--traces", action="store_true", help=_TRACES)
    add_json(parser)


_SAMPLE = """\
Blocks of draws are kept in FILE.blocks until FILE is written. A run that was killed goes on with --resume and gives the
same draws as one that was not.
"""


def sample(commands: Commands) -> None:
    """Add ``fpcal sample``."""
    parser = add_command(commands, "sample", "draw from the posterior of a cell", _SAMPLE)
    add = parser.add_argument
    _add_sweeps(parser)
    add("-o", dest="output", metavar="POSTERIOR.nc", type=Path, required=True, help="draws to write")
    add("--traces", action="store_true", help=_TRACES)
    add("--draws", type=count, default=10_000, help="effective draws of every parameter (default: 10000)")
    add("--seed", type=seed, default=0, help="of the draws (default: 0)")
    kinds = "student: outliers have bounded pull; slip: dL may be off by whole half wavelengths (default: gaussian)"
    add("--likelihood", choices=("gaussian", "student", "slip"), default="gaussian", help=kinds)
    add_prior(parser)
    add("--resume", action="store_true", help="go on with a run that was killed")
    add_json(parser)


_COMPARE = """\
Models stand between commas, settings of one model between plus signs: `opd=axis,opd=perpendicular`, or
`likelihood=gaussian,opd=perpendicular+likelihood=slip`. What is not set is the cell's path model and Gaussian noise.

Models are compared by how well they predict each row from all others (leave-one-out): elpd is the sum of these log
densities, per um. Rows whose Pareto k is too large for importance sampling ("bad k") are left out in earnest
("refitted"). A difference below 4, or below twice its standard error, tells nothing.
"""


def compare(commands: Commands) -> None:
    """Add ``fpcal compare``."""
    parser = add_command(commands, "compare", "say which of several models the data favour", _COMPARE)
    add = parser.add_argument
    _add_sweeps(parser)
    add("--models", required=True, metavar="MODEL,MODEL,..", help="e.g. opd=axis,opd=perpendicular,likelihood=slip")
    add("--draws", type=count, default=2000, help="effective draws of every parameter (default: 2000)")
    add("--seed", type=seed, default=0, help="of the draws (default: 0)")
    add_json(parser)


_TASK_ERROR = """\
TASK is circle, line-x, line-z, tilt-x, tilt-z, spin, all of these (the default), or a PATH.csv (see fpcal control).

The task error is the change of cavity length along the task that the controller does not know of, where the joints can
follow. It is worked out from posterior draws, which an estimate of fpcal identify holds too (500); from an estimate
without draws, to first order from its covariance. --budget prints the uncertainty budget of the worst point (GUM, JCGM
100 and 101), always to first order.

Of bands of 95 % after the paper's end-point sweeps 94 to 95 % hold the true value in simulation, for every task; to
first order from the covariance 91 % do for spin, 93 to 95 % for the others (fpcal study coverage).
"""


def task_error(commands: Commands) -> None:
    """Add ``fpcal task-error``."""
    parser = add_command(commands, "task-error", "predict by how much tasks will be off", _TASK_ERROR)
    add = parser.add_argument
    add("file", metavar="ESTIMATE|POSTERIOR", help="estimate JSON, or posterior draws (.nc)")
    add_task_options(parser, required=False)
    add("--tolerance-nm", type=positive, metavar="T", help="probability that the peak to peak exceeds T")
    add("--estimate", metavar="ESTIMATE", help="with draws: what the controller holds")
    add("--traces", action="store_true", help=_TRACES)
    add("--draws", type=count, default=10_000, help="errors to draw from a covariance (default: 10000)")
    add("--seed", type=seed, default=0, help="of these draws (default: 0)")
    add("--budget", action="store_true", help="print the uncertainty budget of each task")
    add_json(parser)


_VERIFY = """\
CALIBRATION is what `fpcal identify --json` wrote, or a campaign, whose first session counts. Its parameters foresee the
sweeps of --validation, which it was not made from; the cell's drift between two sessions is allowed for.

FAIL: they are off by more than one good calibration in 200. PASS: they are not, and would have shown an error that
brings the task beyond the tolerance and three times its own band. NOT EVALUATED: they might have missed one.
`fpcal plan --validation N` chooses sweeps that would not.
"""


def verify(commands: Commands) -> None:
    """Add ``fpcal verify``."""
    parser = add_command(commands, "verify", "hold a calibration against sweeps it was not made from", _VERIFY)
    add = parser.add_argument
    add("file", metavar="CALIBRATION", help="estimate JSON, or sweeps: CSV or HDF5 campaign")
    add("--validation", required=True, metavar="SESSION|FILE", help="session of the campaign, or a file of sweeps")
    add("--task", metavar="TASK", action="append", help="whose error counts (default: all that the cell can do)")
    add("--radius-um", type=positive, metavar="R", help="of the circle (default: 100, or what the limits allow)")
    add("--tolerance-nm", type=positive, default=50.0, help="error of a task that is worth finding (default: 50)")
    add("--seed", type=seed, default=0, help="of the errors that are tried (default: 0)")
    add_json(parser)


_CONTROL = """\
TASK is circle, line-x, line-z, tilt-x, tilt-z, spin, or a PATH.csv with the columns x_um,y_um,z_um,rx_deg,ry_deg,rz_deg
in the fibre frame, relative to the aligned pose, turns in the order x, y, z about the reflection point.

JOINTS has the columns q1_um .. q6_deg, status (ok, or the reason), predicted_sd_nm (what the cavity length may be off
by, one standard deviation, from the aligned pose to this one). Points that are not ok have neither joint values nor a
prediction, and do not count for the peak to peak.

With mechanics the joints make up for the error motions that the estimate knows, by the direction from which each comes;
the prediction is that of the path as it is driven, and what is gained is said. Joints that are better left alone are.
"""


def control(commands: Commands) -> None:
    """Add ``fpcal control``."""
    parser = add_command(commands, "control", "find the joint path of a task", _CONTROL)
    add = parser.add_argument
    add("--estimate", metavar="ESTIMATE|POSTERIOR", required=True, help="estimate JSON, or posterior draws (.nc)")
    add_task_options(parser, required=True)
    add("--now", metavar="TIME_H|UTC", help="whether it is still valid then (default: this clock, where it is known)")
    add("-o", dest="output", metavar="JOINTS", type=Path, required=True, help=".csv or .mat to write")
    add_json(parser)


_CERTIFICATE = """\
DIR gets certificate.json (calibrated or not, since when, until when, under which conditions, how uncertain each
parameter and task is, hashes), chain.csv (the links in the parameters of Khalil and Kleinfinger) and, with mechanics,
q1.csv and so on: error motions over the joint, named after ISO 230-1: EYX_nm is what an axis along X moves along Y,
EAX_urad how it turns about X, each with the edges of its 95 % band. An estimate that is not to be used gets no such
tables, and its certificate says so. One that a verification contradicts is not called calibrated either.
"""


def certificate(commands: Commands) -> None:
    """Add ``fpcal certificate``."""
    parser = add_command(commands, "certificate", "hand a calibration over", _CERTIFICATE)
    add = parser.add_argument
    add("file", metavar="ESTIMATE", help="estimate JSON")
    add("--verification", metavar="VERIFIED.json", help="of the same session, of fpcal verify")
    add("--now", metavar="TIME_H|UTC", help="whether it is still valid then (default: this clock, where it is known)")
    add("-o", dest="output", metavar="DIR", type=Folder, required=True, help="folder to write, made if it is not there")
    add_json(parser)


_CHECK = """\
TRACE is a CSV with the columns part,t_s,q1_um .. q6_deg,irradiance_v. Lines of part `reference` come first: the robot
stands at the start of the path, and the joint along the optical axis (q2) goes through one fringe or more and back.
Lines of part `path` follow: the path that the controller drove with the estimate (fpcal control). A second reference
scan after the path is welcome: it tells how the signal drifted. `fpcal simulate --path JOINTS.csv --traces` makes such
a file on the simulated cell.

Start at half fringe height (quadrature): move q2 there before the path. At the fringe's maximum 20 nm change the signal
by 0.7 % of its height only, at half height by 8 %.

A calibration is refuted if an error as large as the one measured would be less probable than --level, did the estimate
hold; what the estimate predicts is worked out from its posterior draws, or to first order from its covariance. With
--time-h the cell may have drifted since the time of the estimate as it states; without, the check asks whether the
estimate holds as it is.

-o writes the check as a row of kind `path` for a campaign: dl_um is the peak to peak of the error, signed 0. --points N
adds N sweeps from the path's start to points along it, in one group, which `fpcal track` takes in as measurements.
"""


def check(commands: Commands) -> None:
    """Add ``fpcal check``."""
    parser = add_command(commands, "check", "check a calibration by a path recorded on the cell", _CHECK)
    add = parser.add_argument
    add("trace", metavar="TRACE", help="recorded path: .csv")
    add("--estimate", metavar="ESTIMATE", required=True, help="estimate JSON that the path was made with")
    add("--tolerance-nm", type=positive, metavar="T", help="say whether the path is within T")
    add("--level", type=share, default=0.01, metavar="P", help="refuted below this (default: 0.01)")
    add("-o", dest="output", metavar="CHECK", type=Path, help="the check as sweeps: .csv or .h5")
    add("--points", type=count, metavar="N", help="with -o: sweeps to N points of the path too")
    add("--session", metavar="NAME", default="check", help="with -o: its session (default: check)")
    add("--time-h", type=float, default=None, metavar="T", help="when it was recorded, in hours since day 0")
    for name, unit in (("temperature-c", "C"), ("pressure-hpa", "hPa"), ("humidity-pct", "%%")):
        add(f"--{name}", type=float, metavar="X", help=f"of the air in {unit}; all three or none")
    add("--seed", type=seed, default=0, help="of the draws (default: 0)")
    add_json(parser)
