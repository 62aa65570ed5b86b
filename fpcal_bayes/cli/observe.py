"""``fpcal observe``: what sweeps can tell about a cell, measured or not."""

import argparse

from fpcal_bayes.cli.common import console, warn, write_result
from fpcal_bayes.core.files import write_text
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.observability.observe import observe
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.observe import observe_html, print_observability


def run(options: argparse.Namespace, cell: Cell) -> int:
    sweeps = read_sweeps(options.file, cell, plan=True).of_session(options.session)
    warm_up(cell)
    result = observe(cell, sweeps, sigma=options.sigma_nm * 1e-3)
    title = f"{options.file}, session {','.join(sweeps.sessions)}"
    write_result(options.json, "observe", result.content(), result.trust)
    if options.html is not None:
        write_text(options.html, observe_html(result, title))
    print_observability(result, title, console(options))
    warn(result.warnings)
    return 0 if result.identification is None or result.identification.converged else 1
