"""What a notebook shows of each kind of result: sentences, a table, numbers, a picture, a file."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import singledispatch
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fpcal_bayes.analysis.files import CONTENTS, summarise
from fpcal_bayes.analysis.files import arviz_tree as arviz_tree
from fpcal_bayes.analysis.files import write as write
from fpcal_bayes.analysis.history import session_bounds
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.notebook import html_table
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.observability.observe import Observability
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.tasks.prediction import TaskPrediction
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.report.campaign.figures import prior_posterior_figure
from fpcal_bayes.report.fit import fit_lines, parameter_table
from fpcal_bayes.report.observe import headline
from fpcal_bayes.report.observe import parameter_table as observed_table
from fpcal_bayes.report.pages import BLUE, GREY, VERMILION
from fpcal_bayes.report.posterior import posterior_table
from fpcal_bayes.report.table import Table
from fpcal_bayes.report.tasks import prediction_content, prediction_table
from fpcal_bayes.report.track import session_table, verdict_lines
from fpcal_bayes.tracking.tracker import Track

# Pandas is imported in a function: it takes longer than the work, and only frames pay for it.


@dataclass(frozen=True)
class Shown:
    """All that is shown of one result."""

    table: Table
    columns: Callable[[], dict[str, Any]]  # of the frame; the first is its index
    draw: Callable[[], Figure]
    trust: Trust
    lines: list[str] = field(default_factory=list)

    def summary(self) -> str:
        """Table and sentences."""
        against = [f"not to be used: {self.trust.against}"] if not self.trust.usable else []
        return "\n".join([str(self.table).rstrip(), "", *self.lines, *against]).rstrip()

    def html(self) -> str:
        """The table of a notebook's cell."""
        heads = [f"{column.name} [{column.unit}]" if column.unit else column.name for column in self.table.columns]
        return html_table(self.table.title, heads, [[cell.text for cell in row] for row in self.table.rows])

    @property
    def frame(self) -> Any:
        """The numbers as a pandas DataFrame."""
        import pandas

        columns = self.columns()
        return pandas.DataFrame(columns).set_index(next(iter(columns)))


@singledispatch
def shown(result: Any) -> Shown:
    """What is shown of a result."""
    raise InputError(f"{type(result).__name__}: expected an estimate, a fit, a posterior, a prediction or a track")


@shown.register
def _(result: Estimate) -> Shown:
    at = f"{result.cell.name} at {result.time_h:g} h"
    return Shown(
        parameter_table(result, at), lambda: _parameter_columns(result), lambda: _moved_figure(result, at), result.trust
    )


@shown.register
def _(result: Identification) -> Shown:
    estimate = result.estimate
    return Shown(
        parameter_table(estimate, repr(result)),
        lambda: _parameter_columns(estimate),
        lambda: _moved_figure(estimate, repr(result)),
        estimate.trust,
        fit_lines(result),
    )


@shown.register
def _(result: Observability) -> Shown:
    def columns() -> dict[str, Any]:
        return {"parameter": result.parameters.names, "contraction": result.contraction, "status": list(result.status)}

    def draw() -> Figure:
        figure, axis = _axes("seen by the data: share of the prior variance taken away", len(result.parameters))
        axis.barh(result.parameters.names, result.contraction, color=BLUE)
        axis.invert_yaxis()
        axis.set(xlim=(0, 1), xlabel="contraction [1]")
        return figure

    return Shown(observed_table(result), columns, draw, result.trust, lines=headline(result))


@shown.register
def _(result: Posterior) -> Shown:
    found, free = summarise(result), result.identification.free

    def columns() -> dict[str, Any]:
        told = ("mean", "sd", "q05", "q25", "q50", "q75", "q95", "ess_bulk", "ess_tail", "rhat")
        numbers = {key: [each[key] for each in found.values()] for key in told}
        return {"parameter": list(found), "unit": [free[name].unit for name in found]} | numbers

    def draw() -> Figure:
        tree = arviz_tree(result)
        of = {kind: [tree[kind][name].to_numpy().ravel() for name in free.names] for kind in ("posterior", "prior")}
        return prior_posterior_figure(free, np.array(of["posterior"]).T, np.array(of["prior"]).T)

    return Shown(posterior_table(found, free, repr(result)), columns, draw, result.trust)


@shown.register
def _(result: TaskPrediction) -> Shown:
    def columns() -> dict[str, Any]:
        low, high = 1e3 * result.band()
        along = f"along_{result.task.unit}"
        return {along: result.task.along, "sd_nm": 1e3 * result.sd, "low_nm": low, "high_nm": high}

    def draw() -> Figure:
        low, high = 1e3 * result.band()
        figure, axis = _axes(repr(result), 12)
        axis.fill_between(result.task.along, low, high, color=BLUE, alpha=0.25, label="95 % band")
        axis.plot(result.task.along, 1e3 * result.errors[:3].T, color=GREY, linewidth=0.8)
        axis.set(xlabel=f"along the path [{result.task.unit}]", ylabel="task error [nm]")
        axis.legend(frameon=False)
        return figure

    return Shown(prediction_table([result], [None], result.task.cell.name), columns, draw, result.trust)


@shown.register
def _(result: Track) -> Shown:
    later = result.outcomes[1:]

    def columns() -> dict[str, Any]:
        told = ("session", "time_h", "n_sweeps", "nis", "dof", "verdict")
        return {name: [getattr(outcome, name) for outcome in result.outcomes] for name in told}

    def draw() -> Figure:
        figure, axis = _axes(repr(result), 12)
        times = [outcome.time_h for outcome in later]
        bounds = np.array([session_bounds(outcome) for outcome in later], dtype=float).reshape(-1, 2)
        axis.vlines(times, *bounds.T, color=GREY, linewidth=3, label="95 % of sessions as modelled")
        axis.plot(times, [outcome.nis for outcome in later], ".", color=VERMILION, label="innovation")
        axis.set(xlabel="time [h]", ylabel="innovation squared [1]")
        axis.legend(frameon=False)
        return figure

    return Shown(session_table(result, repr(result)), columns, draw, result.trust, verdict_lines(result))


def _parameter_columns(estimate: Estimate) -> dict[str, Any]:
    content = estimate.content()["parameters"]
    told = ("value", "sd", "unit", "prior_sd", "status")
    return {"parameter": list(content)} | {name: [each[name] for each in content.values()] for name in told}


def _moved_figure(estimate: Estimate, title: str) -> Figure:
    """Each parameter against its prior: from the nominal value, in prior standard deviations."""
    parameters = estimate.parameters
    figure, axis = _axes(title, len(parameters))
    moved, wide = (estimate.values - parameters.nominal) / parameters.prior_sd, estimate.sd / parameters.prior_sd
    axis.axvspan(-1, 1, color=GREY, alpha=0.2, label="prior, 1 sd")
    axis.errorbar(moved, parameters.names, xerr=wide, fmt=".", color=BLUE, label="estimate, 1 sd")
    axis.invert_yaxis()
    axis.set_xlabel("away from nominal [prior sd]")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def _axes(title: str, lines: int) -> tuple[Figure, Axes]:
    """A figure with one pair of axes, as high as so many lines of text."""
    figure = Figure(figsize=(7, 1.5 + 0.22 * lines), layout="constrained")
    axis = figure.subplots()
    axis.set_title(title, fontsize="medium", loc="left")
    axis.grid(alpha=0.3)
    return figure, axis


CONTENTS[TaskPrediction] = "task-error", lambda r: {"tasks": {r.task.name: prediction_content(r, None, r.task)}}
