"""Options of the commands that measure, and look at what was measured."""

from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, Folder, add_command, add_json, columns, count, positive, seed

#: Standard deviation of each simulated dL where none is given.
DEFAULT_SIGMA_NM = 5.0

_CELL = """\
Look:  fpcal cell CELL says where each axis points and turns at joint zero, how mirror and fibre stand, what tasks can
       reach, what is odd and what the file does not state. --at "q2=10,q4=1.5" or "0,10,0,1.5,0,0" (um, deg) moves it
       there. --figure draws it: directions are true, axes are drawn apart.
Make:  fpcal cell --new "x y z rx rz ry" --name lab7 -o lab7.toml works the angles out. A word for each axis from base
       to mirror: x moves along +x of the world, rx turns about it by the right hand, -x and -rx count the other way.
       --side says where the fibre stands as seen from the mirror: +x, minus-x, +y and so on.
       fpcal cell --from-dh TABLE.csv -o CELL.toml takes modified DH parameters (Craig), a row a joint, with the columns
       kind,alpha_deg,a_um,theta_deg,d_um and, if wanted, beta_deg.
A cell whose geometry cannot be right is shown all the same, then refused (exit status 2) with what to mend.
"""


def cell(commands: Commands) -> None:
    """Add ``fpcal cell``."""
    parser = add_command(commands, "cell", "look at a cell, or make one from its axes", _CELL)
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
    add_json(parser)


_SIMULATE = """\
The truth is by default what the paper's full identifications found, linear in time between them; of another robot than
the paper's it is a draw of the cell's prior, by the seed. A TOML file gives another one: a table [parameters] with
lines like `alpha_2 = -90.1` (um, deg; what is not named is nominal), or several [[epoch]] tables with `time_h` and
[epoch.parameters].

--traces records the irradiance in place of dL: FILE is an index for `fpcal ingest`, a CSV with its traces in a folder
beside it or HDF5 with everything inside; the truth goes to FILE_truth.toml. Sweeps have wavelength scans before and
after (--signs paper: X and Z translations only). 200 samples a second for 10 s a sweep, so at least 35 a fringe with
the paper's protocol. The velocity has a ripple of 10 %.

--path records the joint path of `fpcal control -o JOINTS.csv` in place of sweeps, for `fpcal check`.
"""


def simulate(commands: Commands) -> None:
    """Add ``fpcal simulate``."""
    parser = add_command(commands, "simulate", "measure sweeps on a simulated cell", _SIMULATE)
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


_INGEST = """\
INDEX is a CSV with a row for each sweep: session,time_h,label,q1_start_um,..,q6_end_deg,trace, where trace is a CSV
with the columns t_s,joint,irradiance_v (joint: the one that moves, in um or deg). Optional columns: wavelength_nm (of
the laser in vacuum), temperature_c, pressure_hpa, humidity_pct (without all three the index of the air is 1),
scan_before, scan_after (CSV wavelength_nm,irradiance_v), group, kind, utc. Files are named relative to INDEX and lie in
its folder. Or an HDF5 of the same (fpcal simulate --traces -o INDEX.h5), a campaign that fpcal ingest made, or a MATLAB
file with variables of these names: t_s, joint, irradiance_v as cell arrays of vectors.

Traces of other programs are read as they are: text with header lines, tabs, semicolons, decimal commas (oscilloscopes,
LVM, GCS arrays), LabVIEW TDMS (needs npTDMS), MATLAB. --columns t=Time,joint=X,irradiance=CH1 names their columns; a
number for t is the time between two samples in s.

A photodiode does not tell the sign of dL. It is taken from scans before and after, from --estimate, or from the cell's
priors where these leave no doubt; other rows have signed = 0. Doubtful sweeps are no rows of FILE: they are listed,
drawn, and kept in an HDF5 FILE under /doubtful. All traces are kept in an HDF5 FILE, so it can be ingested again.
"""


def ingest(commands: Commands) -> None:
    """Add ``fpcal ingest``."""
    parser = add_command(commands, "ingest", "read sweeps from recorded irradiance", _INGEST)
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
    add_json(parser)


_TRACE = """\
One row per sweep: dL, fringes, visibility, noise, where L turns, how far the joint moved before the mirror did (in its
unit). The figure shows the first doubtful sweep, else the first: signal and fit, fringes found, phase,
residual, reversals, lost motion. FILE is what fpcal ingest reads, or a campaign that it made.
"""


def trace(commands: Commands) -> None:
    """Add ``fpcal trace``."""
    parser = add_command(commands, "trace", "look at recorded irradiance", _TRACE)
    parser.add_argument("file", metavar="FILE", help="recorded sweeps: CSV, HDF5 or MATLAB file")
    called = "what the files of traces call t, joint and irradiance"
    parser.add_argument("--columns", metavar="t=NAME,..", type=columns, help=called)
    parser.add_argument("--label", metavar="NAME", help="this sweep alone")
    parser.add_argument("--figure", metavar="OUT", type=Path, help="draw a sweep: .svg or .png")
    add_json(parser)


_DOCTOR = """\
problem: results are wrong or cannot be had; doubt: they may be; note: good to know. Each finding comes with what to do.
Looks at times and order of the sessions, rows measured twice, signs, joints that never move, poses at limits, what the
calibration cannot see, the fit of each session (slipped counts, outliers, path model, size of the noise), and what
changed from session to session. The exit status is 0 whatever is found; 2 if the file cannot be read.
"""


def doctor(commands: Commands) -> None:
    """Add ``fpcal doctor``."""
    parser = add_command(commands, "doctor", "say what is wrong with a campaign, and what to do about it", _DOCTOR)
    parser.add_argument("file", metavar="FILE", help="sweeps or plan: CSV, or HDF5 campaign")
    add_json(parser)


_OBSERVE = """\
FILE may be a plan, without dl_um and sigma_um: the analysis then averages over the prior. Measured sweeps are analysed
at the maximum of their posterior.
"""


def observe(commands: Commands) -> None:
    """Add ``fpcal observe``."""
    parser = add_command(commands, "observe", "say what sweeps can tell about a cell, measured or not", _OBSERVE)
    add = parser.add_argument
    add("file", metavar="FILE", help="sweeps or plan: CSV, or HDF5 campaign")
    add("--session", metavar="NAME", help="session to use (default: the first)")
    add("--sigma-nm", type=positive, default=5.0, help="standard deviation supposed for rows of a plan (default: 5)")
    add("--html", metavar="OUT", type=Path, help="write a page with figures")
    add_json(parser)
