"""Options of the commands that find the parameters of a cell."""

from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, add_command, add_json, add_prior, count, seed

_IDENTIFY = """\
--free takes groups and names, for example `--free extrinsic` or `--free all,gain_4`. Parameters that are not free are
held at --start (or at nominal), and their uncertainty reaches the result; --hold exact takes them as known.

Status of a parameter: identified (the data tell it); weak (the data halve its prior variance at best); gauge (the data
see it only together with others: its value is the prior's); fixed (held).
"""


def identify(commands: Commands) -> None:
    """Add ``fpcal identify``."""
    parser = add_command(commands, "identify", "find the parameters of a cell from sweeps", _IDENTIFY)
    parser.add_argument("file", metavar="FILE", help="sweeps: CSV, or HDF5 campaign")
    parser.add_argument("--session", metavar="NAME", help="session to use (default: the first)")
    parser.add_argument("--free", default="all", metavar="all|intrinsic|extrinsic|NAME,..", help="what to identify")
    parser.add_argument("--start", metavar="ESTIMATE", help="estimate JSON to start from and to hold the rest at")
    add_prior(parser)
    parser.add_argument("--hold", choices=("consider", "exact"), default="consider", help="how to hold the rest")
    add_json(parser)


_SAMPLE = """\
Blocks of draws are kept in FILE.blocks until FILE is written. A run that was killed goes on with --resume and gives the
same draws as one that was not.
"""


def sample(commands: Commands) -> None:
    """Add ``fpcal sample``."""
    parser = add_command(commands, "sample", "draw from the posterior of a cell", _SAMPLE)
    parser.add_argument("file", metavar="FILE", help="sweeps: CSV, or HDF5 campaign")
    parser.add_argument("-o", dest="output", metavar="POSTERIOR.nc", type=Path, required=True, help="draws to write")
    parser.add_argument("--session", metavar="NAME", help="session to use (default: the first)")
    parser.add_argument(
        "--draws", type=count, default=10_000, help="effective draws of every parameter (default: 10000)"
    )
    parser.add_argument("--seed", type=seed, default=0, help="of the draws (default: 0)")
    parser.add_argument(
        "--likelihood",
        choices=("gaussian", "student", "slip"),
        default="gaussian",
        help="student: outliers have bounded pull; slip: each dL may be off by whole half wavelengths "
        "(default: gaussian)",
    )
    parser.add_argument("--noise-scale", action="store_true", help="infer a factor on sigma_um of all sweeps")
    add_prior(parser)
    parser.add_argument("--resume", action="store_true", help="go on with a run that was killed")
    parser.add_argument("--plots", metavar="DIR", type=Path, help="folder for figures (PNG), made if it is not there")
    parser.add_argument(
        "--pairs", default="", metavar="NAME,..", help="parameters of the pair plot (default: the most correlated)"
    )
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
    parser.add_argument("file", metavar="FILE", help="sweeps: CSV, or HDF5 campaign")
    parser.add_argument(
        "--models", required=True, metavar="MODEL,MODEL,..", help="e.g. opd=axis,opd=perpendicular,likelihood=slip"
    )
    parser.add_argument("--session", metavar="NAME", help="session to use (default: the first)")
    parser.add_argument("--draws", type=count, default=2000, help="effective draws of every parameter (default: 2000)")
    parser.add_argument("--seed", type=seed, default=0, help="of the draws (default: 0)")
    add_json(parser)
