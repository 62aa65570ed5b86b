"""``fpcal trace``: a look at recorded light, sweep by sweep."""

import argparse

import numpy as np

from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.cli.ingest import drawn_sweep, recordings_content
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.fringes.ingest import read_index
from fpcal_bayes.io.recordings import read_recordings
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.report.pages import save_figure
from fpcal_bayes.report.table import plain_table

_COLUMNS = ("sweep", "dL um", "sigma nm", "fringes", "visibility", "noise V", "L turns at", "lost motion")


def run(options: argparse.Namespace, cell: Cell) -> int:
    require_suffix(options.figure, ".svg", ".png")
    index = read_recordings(options.file, cell, options.columns)
    sweeps = index.sweeps
    wanted = sweeps.kind == "sweep" if options.label is None else sweeps.label == options.label
    if not wanted.any():
        what = "a sweep with a trace" if options.label is None else f"one of {', '.join(sweeps.label[:5])}"
        raise InputError(f"{options.file}: no sweep {options.label or ''!r:.40}: expected {what}")
    found = read_index(index, cell, told=np.flatnonzero(wanted))
    index = index.take(np.flatnonzero(wanted))
    content = recordings_content(found, index, cell)
    doubtful = [i for i, row in enumerate(content["sweeps"]) if row["doubtful"]]
    if options.figure is not None:
        reason = content["sweeps"][doubtful[0]]["doubtful"] if doubtful else "read"
        save_figure(drawn_sweep(found, index, cell, doubtful[0] if doubtful else 0, reason), options.figure)
    write_result(options.json, "trace", content, Trust())
    table = plain_table(str(options.file), list(_COLUMNS))
    for row in content["sweeps"]:
        sigma = None if row["sigma_um"] is None else 1e3 * row["sigma_um"]
        numbers = (row["dl_um"], sigma, row["fringes"], row["visibility"], row["noise_v"])
        turns = ", ".join(f"{turn:.4g}" for turn in row["reversals"])
        late = f"{row['lost_motion']:.3g}" if row["lost_motion"] else ""
        table.add_row(row["label"], *("" if x is None else f"{x:.5g}" for x in numbers), turns, late)
    show(options, [table], found.warnings)
    return 0
