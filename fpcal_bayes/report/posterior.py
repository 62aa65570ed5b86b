"""A posterior as a table, and a model comparison."""

from fpcal_bayes.infer.posterior.compare import Comparison
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.report.table import Table, number, plain_table


def posterior_table(summary: dict[str, dict[str, float]], parameters: ParameterSet, title: str) -> Table:
    """Mean, standard deviation and interval of each parameter as `summarise` gives them, and what draws are worth."""
    columns = ["parameter", "unit", "mean", "sd", "5 %", "50 %", "95 %", "ess bulk", "ess tail", "R-hat"]
    table = plain_table(title, columns)
    for name, found in summary.items():
        shown = [number(found[key], found["sd"]) for key in ("mean", "sd", "q05", "q50", "q95")]
        worth = [f"{found['ess_bulk']:.0f}", f"{found['ess_tail']:.0f}", f"{found['rhat']:.4f}"]
        table.add_row(name, parameters[name].unit, *shown, *worth)
    return table


def compare_table(comparison: Comparison, title: str) -> Table:
    """Fit and leave-one-out prediction of each model."""
    columns = ["model", "fit", "chi-square", "expected", "p", "elpd", "se", "p_loo", "bad k", "refits"]
    table = plain_table(title, columns)
    for model in comparison.models:
        fit = model.identification.fit
        numbers = [f"{fit.chi2_data:.1f}", f"{fit.expected:.1f}", f"{fit.p_value:.1g}"]
        word = "poor" if model.poor else "good" if model.spec.likelihood == "gaussian" else "not judged"
        told, loo = ["-"] * 5, model.loo
        if loo is not None:
            told = [number(loo.elpd, loo.se), number(loo.se, loo.se), f"{loo.p_loo:.1f}"]
            told += [str(int(loo.bad.sum())), str(int(loo.refitted.sum()))]
        table.add_row(model.spec.name, "no minimum" if model.state == "no minimum" else word, *numbers, *told)
    return table
