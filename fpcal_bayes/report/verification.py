"""What a verification says, in a table and sentences."""

from rich.table import Table

from fpcal_bayes.infer.verification.power import LEVEL
from fpcal_bayes.infer.verification.verify import LEAST_POWER, Verification


def power_table(made: Verification, title: str) -> Table:
    """Verdict and power by task."""
    table = Table(title=title, title_justify="left")
    for column in ("task", "verdict", "power", "found least likely"):
        table.add_column(column, justify="right" if column == "power" else "left")
    for task in made.power:
        kind, power = made.least_power(task)
        table.add_row(task, made.outcome(task), f"{100 * power:.0f} %", kind)
    return table


def verification_lines(made: Verification) -> list[str]:
    """Sentences: the verdict, what it rests on, and for what it holds."""
    kinds = ", ".join(f"{kind} {p:.2g} ({n} rows)" for kind, (n, p) in made.kinds.items())
    lines = [
        f"verification: {made.verdict} (p = {made.p_value:.2g}, FAIL below {LEVEL:g}; {100 * made.coverage:.0f} % of "
        f"{made.n_rows} rows inside their 95 % bands)",
        f"p by the joints that move: {kinds}",
        "power: probability of finding an error that brings the task beyond its tolerance and three times its band",
    ]
    weak = [task for task in made.power if made.outcome(task) == "NOT EVALUATED"]
    if weak:
        lines.append(
            f"not evaluated: {', '.join(weak)}: these sweeps would miss such an error more often than "
            f"{100 * (1 - LEAST_POWER):.0f} %; fpcal plan --validation N chooses sweeps that would not"
        )
    return [*lines, *made.scope]
