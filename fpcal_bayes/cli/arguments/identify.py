"""Options of the commands that find the parameters of a cell, and of those that use them."""

from argparse import ArgumentParser
from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, Folder, add_prior, add_task_options, count, positive, seed, share

_TRACES = "take every sample of recorded traces in place of rows (FILE: what fpcal ingest reads or made)"


def _add_sweeps(parser: ArgumentParser) -> None:
    sessions = "session to use, or several of an unchanged cell: a,b (default: the first)"
    parser.add_argument("file", metavar="FILE", help="sweeps: CSV, or HDF5 campaign")
    parser.add_argument("--session", metavar="NAME", help=sessions)


def _identify(parser: ArgumentParser) -> None:
    add = parser.add_argument
    _add_sweeps(parser)
    add("--free", default="all", metavar="all|intrinsic|extrinsic|NAME,..", help="what to identify")
    add("--start", metavar="ESTIMATE", help="estimate JSON to start from and to hold the rest at")
    add_prior(parser)
    add("--hold-out", type=share, metavar="SHARE", help="leave this share of the sweeps out, and verify with them")
    add("--hold", choices=("consider", "exact"), default="consider", help="how to hold the rest")
    add("--traces", action="store_true", help=_TRACES)


def _sample(parser: ArgumentParser) -> None:
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


def _compare(parser: ArgumentParser) -> None:
    add = parser.add_argument
    _add_sweeps(parser)
    add("--models", required=True, metavar="MODEL,MODEL,..", help="e.g. opd=axis,opd=perpendicular,likelihood=slip")
    add("--draws", type=count, default=2000, help="effective draws of every parameter (default: 2000)")
    add("--seed", type=seed, default=0, help="of the draws (default: 0)")


def _verify(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("file", metavar="CALIBRATION", help="estimate JSON, or sweeps: CSV or HDF5 campaign")
    add("--validation", required=True, metavar="SESSION|FILE", help="session of the campaign, or a file of sweeps")
    add("--task", metavar="TASK", action="append", help="whose error counts (default: all that the cell can do)")
    add("--radius-um", type=positive, metavar="R", help="of the circle (default: 100, or what the limits allow)")
    add("--tolerance-nm", type=positive, default=50.0, help="error of a task that is worth finding (default: 50)")
    add("--seed", type=seed, default=0, help="of the errors that are tried (default: 0)")


def _task_error(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("file", metavar="ESTIMATE|POSTERIOR", help="estimate JSON, or posterior draws (.nc)")
    add_task_options(parser, required=False)
    add("--tolerance-nm", type=positive, metavar="T", help="probability that the peak to peak exceeds T")
    add("--estimate", metavar="ESTIMATE", help="with draws: what the controller holds")
    add("--traces", action="store_true", help=_TRACES)
    add("--draws", type=count, default=10_000, help="errors to draw from a covariance (default: 10000)")
    add("--seed", type=seed, default=0, help="of these draws (default: 0)")
    add("--budget", action="store_true", help="print the uncertainty budget of each task")
    add("--sweeps", metavar="FILE", help="with --budget: sweeps that the estimate was made from")
    add("--session", metavar="NAME", help="session of these sweeps (default: the first)")


def _control(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("--estimate", metavar="ESTIMATE|POSTERIOR", required=True, help="estimate JSON, or posterior draws (.nc)")
    add_task_options(parser, required=True)
    add("--now", metavar="TIME_H|UTC", help="whether it is still valid then (default: this clock, where it is known)")
    add("-o", dest="output", metavar="JOINTS", type=Path, required=True, help=".csv or .mat to write")


def _check(parser: ArgumentParser) -> None:
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


def _certificate(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("file", metavar="ESTIMATE", help="estimate JSON")
    add("--verification", metavar="VERIFIED.json", help="of the same session, of fpcal verify")
    add("--now", metavar="TIME_H|UTC", help="whether it is still valid then (default: this clock, where it is known)")
    add("-o", dest="output", metavar="DIR", type=Folder, required=True, help="folder to write, made if it is not there")


#: Names, summaries and options, in the order of the work.
COMMANDS: Commands = (
    ("identify", "find the parameters of a cell from sweeps", _identify),
    ("sample", "draw from the posterior of a cell", _sample),
    ("compare", "say which of several models the data favour", _compare),
    ("verify", "hold a calibration against sweeps it was not made from", _verify),
    ("task-error", "predict by how much tasks will be off", _task_error),
    ("control", "find the joint path of a task", _control),
    ("check", "check a calibration by a path recorded on the cell", _check),
    ("certificate", "hand a calibration over", _certificate),
)
