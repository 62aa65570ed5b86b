"""Options of the commands that drive the live cell, or an emulated one."""

from pathlib import Path

from fpcal_bayes.cli.arguments.common import Commands, add_command, add_costs, add_goal, count


def measure(commands: Commands) -> None:
    """Add ``fpcal measure``."""
    parser = add_command(commands, "measure", "drive a ticket on the live cell")
    add = parser.add_argument
    add("ticket", metavar="TICKET", help="ticket or plan: CSV without measured values")
    add("--rig", metavar="RIG", required=True, help="devices: RIG.toml")
    add("-o", dest="output", metavar="SESSION", type=Path, required=True, help="session to write: .h5 or .csv")
    add("--campaign", metavar="C", help="campaign that the session will belong to: its clock, its past")
    add("--estimate", metavar="ESTIMATE", help="geometry that tells the gap (default: the nominal one)")
    add("--dry-run", action="store_true", help="look at every move and make none")


def rig(commands: Commands) -> None:
    """Add ``fpcal rig``."""
    parser = add_command(commands, "rig", "emulate the devices of a cell")
    parser.add_argument("--emulate", metavar="RIG", required=True, help="devices to emulate: RIG.toml")
    written = "rig file to write (default: RIG_live.toml)"
    parser.add_argument("-o", dest="output", metavar="LIVE", type=Path, help=written)


def serve(commands: Commands) -> None:
    """Add ``fpcal serve``."""
    parser = add_command(commands, "serve", "answer controllers over HTTP from the current best estimate")
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
