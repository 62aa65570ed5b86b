"""Options of the commands that simulate a week, or many."""

from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, add_command, add_goal, add_json, count, positive, seed

_WEEK = """\
The truth goes through the paper's tables on days 0, 1, 2 and 8. It is lived through three times: by the paper's
protocol (69 sweeps on days 0, 1, 2, 7 and 8, the extrinsic parameters alone on day 7), by a filter that takes in the
same sweeps, and under the policy of fpcal decide, which holds a circle of 100 um radius within 50 nm.

Writes into DIR: campaign.h5 (sweeps of the paper's protocol, truth, an estimate a session, and the filter's track),
policy.h5 (day 0 and the policy's sweeps, truth, its track and decisions), an estimate JSON a session, estimate.json
(the policy's last), report.html (fpcal report of campaign.h5), report.txt (the paper's Tables II to VII anew beside the
truth, circles, what each way held and cost, and the posterior of day 0), posterior.nc (its draws), circles/ (the
irradiance along each circle, for fpcal check), extrinsics.svg, circles.svg, courses.svg.
"""


def week(commands: Commands) -> None:
    """Add ``fpcal week``."""
    parser = add_command(commands, "week", "run the paper's week on a simulated cell", _WEEK)
    parser.add_argument(
        "-o", dest="output", metavar="DIR", type=Path, default=Path("week"), help="folder (default: week)"
    )
    parser.add_argument("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    parser.add_argument("--seed", type=seed, default=0, help="of the noise (default: 0)")
    parser.add_argument(
        "--between", choices=("steady", "walk"), default="steady", help="how the truth gets from one of the paper's "
        "tables to the next: steadily, or on a random walk with the cell's drift sizes (default: steady)"
    )  # fmt: skip
    parser.add_argument("--no-page", dest="page", action="store_false", help="leave out report.html")


_STUDY = """\
coverage  does the truth lie in the predicted bands of each task?
sbc       simulation-based calibration: are the truths uniformly ranked among posterior draws?
policy    weeks of drift under several policies: share of time in tolerance against sweeps spent
plan      does a plan do as well as the paper's sweeps?

Replicate K is the same whenever and wherever it runs. Each is put into STORE as soon as it is there. A study that was
stopped, or killed, goes on when the command is given again, and leaves the same file byte for byte; a larger
--replicates adds to it. Workers that die lose nothing: what they had is given to others.

Without --scheduler the workers are processes of this machine. A cluster is started with `dask scheduler` and, wherever
fpcal_bayes of the same version is installed, `dask worker tcp://HOST:PORT --nthreads 1`. Dask hands pickles on: name
a scheduler that you trust only.
"""


def study(commands: Commands) -> None:
    """Add ``fpcal study``."""
    parser = add_command(commands, "study", "run many independent replicates of a question", _STUDY)
    parser.add_argument(
        "study", metavar="NAME", choices=("coverage", "sbc", "policy", "plan"), help="coverage, sbc, policy or plan"
    )
    parser.add_argument("--replicates", type=count, required=True, metavar="N", help="how many in all")
    parser.add_argument("-o", dest="output", metavar="STORE", type=Path, help="store (default: study-NAME.h5)")
    parser.add_argument("--anew", action="store_true", help="forget what the store holds")
    parser.add_argument("--scheduler", metavar="tcp://HOST:PORT", help="of a Dask cluster that runs already")
    parser.add_argument("--workers", type=count, metavar="N", help="processes on this machine (default: its cores)")
    parser.add_argument("--seed", type=seed, default=0, help="of the study (default: 0)")
    parser.add_argument("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    parser.add_argument(
        "--protocol",
        default="paper",
        metavar="paper|paper-mid|SWEEPS",
        help="coverage, sbc: sweeps of each calibration (default: paper); sbc also: random",
    )
    parser.add_argument("--draws", type=count, default=400, help="sbc: effective draws of a posterior (default: 400)")
    parser.add_argument("--plan", metavar="SWEEPS", help="plan: whole sweeps, as fpcal plan writes them")
    parser.add_argument("--readings", type=count, default=2, metavar="K", help="plan: of each sweep (default: 2)")
    parser.add_argument("--policies", metavar="NAME;..", help="policy: which (a wrong name lists all)")
    parser.add_argument("--hours", type=positive, default=192.0, help="policy: length of a week (default: 192)")
    parser.add_argument("--harder", action="store_true", help="policy: weeks that drift otherwise than modelled too")
    add_goal(parser)
    add_json(parser)
