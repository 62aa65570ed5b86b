"""``fpcal cell``: look at a cell, or make one from the directions of its axes."""

import argparse
from pathlib import Path

import numpy as np

import fpcal_bayes.report as report
from fpcal_bayes.analysis.cell_view import view_cell
from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import read_text, require_suffix, write_text
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.io.cell import cell_path, load_cell
from fpcal_bayes.io.new_cell import new_cell_text, read_dh_table
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.check import impossible
from fpcal_bayes.model.cell.layout import layout_of_axes, layout_of_links, read_axes, read_side
from fpcal_bayes.report.cell import cell_words


def run(options: argparse.Namespace) -> int:
    if options.new is None and options.from_dh is None and options.output is None:
        return _look(options, options.file or options.cell)
    return _make(options)


def _look(options: argparse.Namespace, source: str | Path) -> int:
    require_suffix(options.figure, ".svg", ".png")
    cell = load_cell(source, opd=options.opd, check=False)
    q = None if options.at is None else joints_at(cell, options.at)
    if next(impossible(cell), None) is None:
        warm_up_inverse(cell)
    view = view_cell(cell, q)
    if options.figure is not None:
        report.save_figure(report.cell_figure(view), options.figure)
    write_result(options.json, "cell", view.content())
    show(options, cell_words(view))
    if view.refused:
        raise InputError(f"{source}: {view.refused}")
    return 0


def _make(options: argparse.Namespace) -> int:
    copied = options.new is None and options.from_dh is None
    if options.output is None or options.output.suffix.lower() != ".toml":
        raise InputError("expected -o CELL.toml, where the new cell is written")
    if copied != (options.file is not None) or options.at is not None:
        raise InputError("-o CELL: expected one of --new AXES, --from-dh TABLE and a CELL to copy, without --at")
    if options.output.exists():
        raise InputError(f"{options.output}: is there already, expected another name for the new cell")
    write_text(options.output, read_text(cell_path(options.file)) if copied else _new_text(options))
    try:
        load_cell(options.output)
    except InputError:
        options.output.unlink()
        raise
    return _look(options, options.output)


def _new_text(options: argparse.Namespace) -> str:
    name = options.name or options.output.stem
    if not name.isprintable() or not name.strip() or '"' in name or "\\" in name or len(name) > 100:
        raise InputError(f"--name {name!r:.40}: expected a line of text without quotes")
    side = read_side(options.side)
    if options.new is not None:
        layout = layout_of_axes(read_axes(options.new), side, options.gap_um)
    else:
        layout = layout_of_links(*read_dh_table(options.from_dh), side, options.gap_um)
    opd, gap_sd_um = options.opd or "axis", options.gap_sd_um
    return new_cell_text(layout, name, wavelength_nm=options.wavelength_nm, opd=opd, gap_sd_um=gap_sd_um)


def joints_at(cell: Cell, text: str) -> Floats:
    """A joint vector in um and rad from ``q2=10,q4=1.5`` or ``0,10,0,1.5,0,0``; `InputError` if it is neither."""
    shown = np.zeros(len(cell.joints))
    parts = [part.strip() for part in text.split(",")]
    named = "=" in text
    if not named and len(parts) != len(shown):
        raise InputError(f"--at {text!r:.40}: expected {len(shown)} values, or q1=VALUE,.. with those not zero")
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
    return np.asarray(shown * cell.joint_scales)
