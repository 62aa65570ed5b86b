"""Tables of posterior draws; apart from the others, since what they need takes long to import."""

from rich.table import Table

from fpcal_bayes.infer.posterior.output import summarise
from fpcal_bayes.infer.posterior.sample import Posterior
from fpcal_bayes.report.tables import number, plain_table


def posterior_table(posterior: Posterior, title: str) -> Table:
    """Mean, standard deviation and interval of each parameter, with what the draws are worth."""
    columns = ["parameter", "unit", "mean", "sd", "5 %", "50 %", "95 %", "ess bulk", "ess tail", "R-hat"]
    table = plain_table(title, columns)
    for name, entry in summarise(posterior).items():
        numbers = [number(entry[key], entry["sd"]) for key in ("mean", "sd", "q05", "q50", "q95")]
        sizes = [f"{entry['ess_bulk']:.0f}", f"{entry['ess_tail']:.0f}", f"{entry['rhat']:.4f}"]
        table.add_row(name, posterior.identification.free[name].unit, *numbers, *sizes)
    return table
