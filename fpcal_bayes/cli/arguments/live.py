"""Options of the commands that drive the live cell, or an emulated one."""

from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, add_command, add_costs, add_goal, count

_MEASURE = """\
Before the first move every move of the ticket is held to the joints' limits, the cell's envelope and the least gap of
RIG.toml; --dry-run stops there and shows moves, times, gap and fringe rate. Positions read back are what is stored.
Each sweep ends with a return to its start; one whose length does not close is driven again, then kept apart as
doubtful. Ctrl-C, a lost device or a forbidden move stop all axes at once; what was measured is kept in SESSION, and the
same command goes on from there (SESSION.journal). Every message to a device stands in the log beside SESSION.

A ticket without rows does nothing. Out of date, used up or measured already: refused.
"""


def measure(commands: Commands) -> None:
    """Add ``fpcal measure``."""
    parser = add_command(commands, "measure", "drive a ticket on the live cell", _MEASURE)
    add = parser.add_argument
    add("ticket", metavar="TICKET", help="ticket or plan: CSV without measured values")
    add("--rig", metavar="RIG", required=True, help="devices: RIG.toml")
    add("-o", dest="output", metavar="SESSION", type=Path, required=True, help="session to write: .h5 or .csv")
    add("--campaign", metavar="C", help="campaign that the session will belong to: its clock, its past")
    add("--estimate", metavar="ESTIMATE", help="geometry that tells the gap (default: the nominal one)")
    add("--dry-run", action="store_true", help="look at every move and make none")


_RIG = """\
All devices of RIG.toml listen on loopback and speak their real protocols; behind them is one simulated cell whose truth
drifts. Port 0 takes a free one: LIVE is RIG.toml with the ports that are open and the clock that runs, for
`fpcal measure --rig LIVE`. [clock] speedup lets the cell's time run faster; [emulate] gives truth, seed, hour and
faults. Ends with Ctrl-C.
"""


def rig(commands: Commands) -> None:
    """Add ``fpcal rig``."""
    parser = add_command(commands, "rig", "emulate the devices of a cell", _RIG)
    parser.add_argument("--emulate", metavar="RIG", required=True, help="devices to emulate: RIG.toml")
    written = "rig file to write (default: RIG_live.toml)"
    parser.add_argument("-o", dest="output", metavar="LIVE", type=Path, help=written)


_SERVE = """\
GET /estimate, /decision, /suggest?n=4, /report, /health, /openapi.json; POST /joints (poses or a task) and /sweeps
(CSV of a measured session). Files are looked at anew for every answer: let `fpcal keep` write them. Joints are refused
where the estimate is not to be used or out of date, unless the request repeats the reason, and where a way may leave
the cell's envelope. GET /clients/fpcal_client.m and /clients/fpcal_client.py are programs that ask.

Listens on loopback. Another address needs --token FILE, whose text every request then carries as `Authorization: Bearer
TEXT`. Ends with Ctrl-C.
"""


def serve(commands: Commands) -> None:
    """Add ``fpcal serve``."""
    parser = add_command(commands, "serve", "answer controllers over HTTP from the current best estimate", _SERVE)
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
