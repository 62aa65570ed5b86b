"""``fpcal doctor``: what is wrong with a campaign, and what to do about it."""

import argparse

from rich.markup import escape

from fpcal_bayes.analysis.doctor import doctor
from fpcal_bayes.cli.common import console, write_result
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.trust import Reason, Trust


def run(options: argparse.Namespace, cell: Cell) -> int:
    sweeps = read_sweeps(options.file, cell, plan=True)
    warm_up(cell)
    findings = doctor(sweeps, cell)
    trust = Trust(tuple(Reason("problem", found.what) for found in findings if found.severity == "problem"))
    write_result(options.json, "doctor", {"findings": [finding.content() for finding in findings]}, trust)
    out = console(options)
    styles = {"problem": "red", "doubt": "yellow", "note": "dim"}
    for finding in findings:
        where = f" in session {finding.where}" if finding.where else ""
        style, kind = styles[finding.severity], escape(finding.kind + where)
        out.print(f"[{style}]{finding.severity}[/] ({kind}): {escape(finding.what)}", soft_wrap=True)
        out.say(f"    what to do: {finding.remedy}")
    counts = [f"{counted(sum(f.severity == severity for f in findings), severity)}" for severity in styles]
    rows = f"{counted(len(sweeps), 'row')}, {counted(len(sweeps.sessions), 'session')}"
    out.say(f"{options.file}: {rows}: {', '.join(counts)}")
    return 0
