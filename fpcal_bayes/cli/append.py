"""``fpcal append``: a measured session joins its campaign."""

import argparse

from fpcal_bayes.analysis.append import append
from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.model.cell.cell import Cell


def run(options: argparse.Namespace, cell: Cell) -> int:
    done = append(options.campaign, options.measured, cell, ticket=options.ticket)
    warnings = []
    if done.n_missing:
        warnings.append(f"not measured: {counted(done.n_missing, 'row')} that the ticket asks for")
    content = {"sessions": list(done.sessions), "n_rows": done.n_rows, "n_missing": done.n_missing}
    write_result(options.json, "append", content | {"warnings": warnings})
    what = f"session {', '.join(done.sessions)} with {counted(done.n_rows, 'row')}"
    said = f"{options.campaign}: {what} added, {done.n_sessions} in all"
    if not done.sessions:
        said = f"{options.ticket}: asks for nothing that is not there, nothing to append"
    show(options, [said], warnings)
    return 0
