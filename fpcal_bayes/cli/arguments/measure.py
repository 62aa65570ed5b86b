"""Options of the commands that measure, and look at what was measured."""

from argparse import ArgumentParser
from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, Folder, columns, count, positive, seed

#: Standard deviation of each simulated dL where none is given.
DEFAULT_SIGMA_NM = 5.0


def _cell(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("file", metavar="CELL", nargs="?", help="cell TOML file, or built-in cell (femto-st)")
    add("--at", metavar="Q", help="joint values, in um and deg (default: joint zero)")
    add("--figure", metavar="OUT", type=Path, help="draw the cell: .svg or .png")
    make = parser.add_mutually_exclusive_group()
    make.add_argument("--new", metavar="AXES", help='make a cell from words such as "x y z rx rz ry"')
    make.add_argument("--from-dh", metavar="TABLE", help="make a cell from a CSV of modified DH parameters")
    add("-o", dest="output", metavar="CELL", type=Path, help="cell file to write: .toml")
    add("--name", help="of the new cell (default: that of its file)")
    add("--side", default="+y", metavar="AXIS", help="where the fibre stands: +y (default), minus-y, ..")
    add("--gap-um", type=positive, default=920.0, metavar="L", help="of the new cell (default: 920)")
    add("--gap-sd-um", type=positive, metavar="S", help="standard deviation of that gap, if measured")
    add("--wavelength-nm", type=positive, default=1550.0, metavar="W", help="of the new cell's laser (default: 1550)")


def _simulate(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("-o", dest="output", metavar="FILE", type=Path, required=True, help="sweeps to write: .csv or .h5")
    add("--truth", metavar="TOML", help="true parameters (default: those of the paper)")
    sweeps = "which sweeps: the paper's 69, the same with a midpoint each, or those of a file (default: paper)"
    add("--protocol", metavar="paper|paper-mid|SWEEPS.csv", help=sweeps)
    add("--signs", choices=("all", "paper"), help="paper: the direction of dL is known for X and Z translations only")
    add("--sigma-nm", type=positive, metavar="S", help=f"standard deviation of each dL (default: {DEFAULT_SIGMA_NM:g})")
    add("--seed", type=seed, default=0, help="of the noise (default: 0)")
    add("--traces", action="store_true", help="record the irradiance, for fpcal ingest")
    add("--path", metavar="JOINTS", help="with --traces: record this joint path, for fpcal check")
    add("--time-h", type=float, metavar="T", help="with --path: hours since day 0 (default: 0)")


def _ingest(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("index", metavar="INDEX", help="recorded sweeps: CSV, HDF5 or MATLAB file")
    add("-o", dest="output", metavar="FILE", type=Path, required=True, help="sweeps to write: .csv or .h5")
    add("--columns", metavar="t=NAME,..", type=columns, help="what the files of traces call t, joint and irradiance")
    add("--estimate", metavar="ESTIMATE", help="estimate JSON that tells signs and doubtful counts")
    add("--points", type=count, metavar="N", help="rows for N interior points of each sweep too")
    add("--absolute", action="store_true", help="rows for the absolute lengths of all scans too")
    add("--wavelength-sd-pm", type=positive, metavar="PM", help="standard deviation of the laser's wavelength")
    add("--index-sd", type=positive, metavar="SD", help="standard deviation of the air's index")
    about = "operator, serial numbers: kept in an HDF5 FILE, shown by the report"
    add("--about", metavar="TEXT", default="", help=about)
    plots = parser.add_mutually_exclusive_group()
    plots.add_argument(
        "--plots", metavar="DIR", type=Folder, help="folder for pictures of doubtful sweeps (default: FILE_doubtful)"
    )
    plots.add_argument("--no-plots", action="store_true", help="draw nothing")


def _trace(parser: ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="recorded sweeps: CSV, HDF5 or MATLAB file")
    called = "what the files of traces call t, joint and irradiance"
    parser.add_argument("--columns", metavar="t=NAME,..", type=columns, help=called)
    parser.add_argument("--label", metavar="NAME", help="this sweep alone")
    parser.add_argument("--figure", metavar="OUT", type=Path, help="draw a sweep: .svg or .png")


def _doctor(parser: ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="sweeps or plan: CSV, or HDF5 campaign")


def _observe(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("file", metavar="FILE", help="sweeps or plan: CSV, or HDF5 campaign")
    add("--session", metavar="NAME", help="session to use (default: the first)")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation supposed for rows of a plan (default: 5)")
    add("--html", metavar="OUT", type=Path, help="write a page with figures")


#: Names, summaries and options, in the order of the work.
COMMANDS: Commands = (
    ("cell", "look at a cell, or make one from its axes", _cell),
    ("simulate", "measure sweeps on a simulated cell", _simulate),
    ("ingest", "read sweeps from recorded irradiance", _ingest),
    ("trace", "look at recorded irradiance", _trace),
    ("doctor", "say what is wrong with a campaign, and what to do about it", _doctor),
    ("observe", "say what sweeps can tell about a cell, measured or not", _observe),
)
