"""What a verification says, in a table and sentences."""

from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.verification.power import LEVEL
from fpcal_bayes.infer.verification.verify import LEAST_POWER, Verification
from fpcal_bayes.report.table import Table, TableCell, plain_table

_STYLES = {"PASS": "good", "FAIL": "bad", "NOT EVALUATED": "caution"}


def power_table(made: Verification, title: str) -> Table:
    """Verdict and power by task."""
    table = plain_table(title, ["task", "verdict", "power [%]", "found least likely"], words=(0, 1, 3))
    for task in made.power:
        kind, power = made.least_power(task)
        verdict = made.outcome(task)
        table.add_row(task, TableCell(verdict, style=_STYLES[verdict]), f"{100 * power:.0f}", kind)
    return table


def verification_lines(made: Verification) -> list[str]:
    """Sentences: the verdict, what it rests on, and for what it holds."""
    kinds = ", ".join(f"{kind} {p:.2g} ({counted(n, 'row')})" for kind, (n, p) in made.kinds.items())
    lines = [
        f"verification: {made.verdict} (p = {made.p_value:.2g}, FAIL below {LEVEL:g}; {100 * made.coverage:.0f} % of "
        f"{counted(made.n_rows, 'row')} inside their 95 % bands)",
        f"p-values by the joints that move: {kinds}",
        "power: probability of finding an error that brings the task beyond its tolerance and three times its band",
    ]
    weak = [task for task in made.power if made.outcome(task) == "NOT EVALUATED"]
    if weak:
        lines.append(
            f"not evaluated: {', '.join(weak)}: these sweeps would miss such an error more often than "
            f"{100 * (1 - LEAST_POWER):.0f} %; fpcal plan --validation N --after FILE chooses sweeps that would not"
        )
    return lines if made.failed else [*lines, *made.scope]


def verification_sentences(made: Verification | None, file: str) -> list[str]:
    """The same for a page on the campaign of a file, or how to get there."""
    if made is not None:
        # Names of joints stay as they are.
        told = verification_lines(made)
        return [f"{line[0] if line[1].isdigit() else line[0].upper()}{line[1:]}." for line in told]
    return [
        f"Not verified by sweeps that it was not made from. Choose some with fpcal plan --validation 12 --after {file} "
        f"-o PLAN.csv, measure them, then fpcal verify {file} --validation MEASURED.csv --json verified.json, and give "
        "the report --verification verified.json."
    ]
