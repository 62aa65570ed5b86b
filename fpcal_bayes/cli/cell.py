"""``fpcal cell``: look at a cell, or make one from the directions of its axes."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    check_output,
    console,
    positive,
    write_result,
)
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import write_text
from fpcal_bayes.io.cell import read_cell

if TYPE_CHECKING:
    from fpcal_bayes.core.typing import Floats
    from fpcal_bayes.model.cell.cell import Cell
    from fpcal_bayes.model.cell.layout import Layout

_EPILOG = """\
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


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "cell", "look at a cell, or make one from its axes", run, _EPILOG)
    parser.add_argument("file", metavar="CELL", nargs="?", help="cell TOML file, or built-in cell (femto-st)")
    parser.add_argument("--at", metavar="Q", help="joint values, in um and deg (default: joint zero)")
    parser.add_argument("--figure", metavar="OUT", type=Path, help="draw the cell: .svg or .png")
    make = parser.add_mutually_exclusive_group()
    make.add_argument("--new", metavar="AXES", help='make a cell from words such as "x y z rx rz ry"')
    make.add_argument("--from-dh", metavar="TABLE", help="make a cell from a CSV of modified DH parameters")
    parser.add_argument("-o", dest="output", metavar="CELL", type=Path, help="cell file to write: .toml")
    parser.add_argument("--name", help="of the new cell (default: that of its file)")
    parser.add_argument(
        "--side", default="+y", metavar="AXIS", help="where the fibre stands: +y (default), minus-y, .."
    )
    parser.add_argument("--gap-um", type=positive, default=920.0, metavar="L", help="of the new cell (default: 920)")
    parser.add_argument("--gap-sd-um", type=positive, metavar="S", help="standard deviation of that gap, if measured")
    parser.add_argument(
        "--wavelength-nm", type=positive, default=1550.0, metavar="W", help="of the new cell's laser (default: 1550)"
    )
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.new is not None or options.from_dh is not None:
        return _make(options)
    if options.output is not None:
        raise InputError("-o CELL: expected --new AXES or --from-dh TABLE, what the new cell is made from")
    return _look(options, options.file or options.cell)


def _look(options: argparse.Namespace, source: str | Path) -> int:
    from fpcal_bayes.analysis.cell_view import view_cell
    from fpcal_bayes.cli.control import warm_up_inverse
    from fpcal_bayes.model.cell.check import impossible
    from fpcal_bayes.report.cell import cell_figure, cell_words
    from fpcal_bayes.report.svg import svg_text

    check_output(options.figure, source)
    check_output(options.json, source, options.figure)
    if options.figure is not None and options.figure.suffix.lower() not in (".svg", ".png"):
        raise InputError(f"{options.figure}: expected a file name that ends in .svg or .png")
    cell = read_cell(source, check=False)
    cell = cell if options.opd is None else cell.with_opd(options.opd)
    q = None if options.at is None else joints_at(cell, options.at)
    if len(cell.joints) <= 6 and next(impossible(cell), None) is None:
        warm_up_inverse(cell)
    view = view_cell(cell, q)
    out = console(options)
    for line in cell_words(view):
        out.print(line, soft_wrap=True, markup=False)
    if options.figure is not None:
        figure = cell_figure(view)
        if options.figure.suffix.lower() == ".png":
            figure.savefig(options.figure, dpi=130)
        else:
            write_text(options.figure, svg_text(figure) + "\n")
    write_result(options.json, "cell", view.content())
    if view.refused:
        raise InputError(f"{source}: {view.refused}")
    return 0


def _make(options: argparse.Namespace) -> int:
    from fpcal_bayes.io.new_cell import new_cell_text

    if options.output is None or options.output.suffix.lower() != ".toml":
        raise InputError("expected -o CELL.toml, where the new cell is written")
    if options.file is not None or options.at is not None:
        raise InputError("--new and --from-dh make a cell: expected neither CELL nor --at beside them")
    if options.output.exists():
        raise InputError(f"{options.output}: is there already, expected another name for the new cell")
    check_output(options.output, options.from_dh)
    name = options.name or options.output.stem
    if not name.isprintable() or not name.strip() or '"' in name or "\\" in name or len(name) > 100:
        raise InputError(f"--name {name!r:.40}: expected a line of text without quotes")
    text = new_cell_text(
        _layout(options),
        name,
        wavelength_nm=options.wavelength_nm,
        opd=options.opd or "axis",
        gap_sd_um=options.gap_sd_um,
    )
    write_text(options.output, text)
    try:
        read_cell(options.output)
    except InputError:
        options.output.unlink()
        raise
    return _look(options, options.output)


def _layout(options: argparse.Namespace) -> "Layout":
    from fpcal_bayes.io.new_cell import read_dh_table
    from fpcal_bayes.model.cell.layout import layout_of_axes, layout_of_links, read_axes, read_side

    side = read_side(options.side)
    if options.new is not None:
        return layout_of_axes(read_axes(options.new), side, options.gap_um)
    return layout_of_links(*read_dh_table(options.from_dh), side, options.gap_um)


def joints_at(cell: "Cell", text: str) -> "Floats":
    """A joint vector in um and rad from ``q2=10,q4=1.5`` or ``0,10,0,1.5,0,0``; `InputError` if it is neither."""
    import numpy as np

    shown = np.zeros(len(cell.joints))
    parts = [part.strip() for part in text.split(",")]
    named = "=" in text
    if not named and len(parts) != len(shown):
        raise InputError(
            f"--at {text!r:.40}: expected {len(shown)} values, or q1=VALUE,.. with those that are not zero"
        )
    for i, part in enumerate(parts):
        name, _, value = part.rpartition("=")
        known = [f"q{j + 1}" for j in range(len(shown))]
        if named and name.strip() not in known:
            raise InputError(f"--at {part!r:.40}: expected one of {', '.join(known)}, then = and its value")
        try:
            shown[known.index(name.strip()) if named else i] = float(value)
        except ValueError as error:
            raise InputError(f"--at {part!r:.40}: expected a number in um or deg") from error
    if not np.isfinite(shown).all():
        raise InputError(f"--at {text!r:.40}: expected finite numbers")
    internal: Floats = shown * cell.joint_scales
    return internal
