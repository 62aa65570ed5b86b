"""Figures of a campaign's report, as SVG text."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.analysis.campaign import CampaignFacts
from fpcal_bayes.analysis.history import History, SessionResiduals, TaskForecasts
from fpcal_bayes.analysis.motions import MotionCurve
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.report.pages import BLUE, GREY, ORANGE, VERMILION, drawable, svg_figure

_MOST_MOTIONS = 12
_HOURS_PER_DAY = 24.0
#: Draws that a density is made of at most, evenly spaced ones of longer runs.
_SHOWN_DRAWS = 1000
_N_COLUMNS = 4


def task_figure(facts: CampaignFacts) -> str:
    """The 95 % band of each task's error along its path, with the tolerance."""
    drawn = [outlook for outlook in facts.tasks if outlook.prediction is not None and facts.trust.usable]
    n_rows = -(-len(drawn) // 3)
    if not drawn:
        return ""
    with svg_figure(9.6, 0.6 + 2.3 * n_rows, panels=True) as (figure, svg):
        axes = [figure.add_subplot(n_rows, 3, number) for number in range(1, len(drawn) + 1)]
        half = 1e3 * facts.goal.tolerance_um / 2
        for axis, outlook in zip(axes, drawn, strict=True):
            found, prediction = outlook.numbers, outlook.prediction
            assert found is not None
            assert prediction is not None
            along, low, high = found.task.along, found.low, found.high
            axis.fill_between(along, low, high, color=BLUE, alpha=0.25, linewidth=0, label="95 % band")
            errors = 1e3 * prediction.errors
            typical = errors[np.argsort(np.ptp(errors, axis=1))[len(errors) // 2]]
            axis.plot(along, typical, color=BLUE, linewidth=0.9, label="an error of median size")
            axis.axhline(half, color=VERMILION, linestyle="--", linewidth=1, label=f"tolerance, {2 * half:g} nm")
            axis.axhline(-half, color=VERMILION, linestyle="--", linewidth=1)
            most = 1.15 * max(half, float(np.abs([low, high, typical]).max()))
            title = drawable(outlook.name) + (" (to be held)" if outlook.asked else "")
            axis.set_title(title, fontsize=9, parse_math=False)
            axis.set(ylim=(-most, most), xlabel=f"along the path [{found.task.unit}]")
            axis.set_ylabel("error [nm]")
            axis.grid(alpha=0.3)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return svg[0]


def outlook_figure(facts: CampaignFacts, found: TaskForecasts) -> str:
    """Error of the worst task through time: it grows between sessions and falls at each."""
    with svg_figure(9.6, 3.4) as (figure, svg):
        axis = figure.subplots()
        days, low, high = found.hours / _HOURS_PER_DAY, 1e3 * found.low, 1e3 * found.high
        axis.fill_between(days, low, high, color=BLUE, alpha=0.25, linewidth=0, label="95 % band")
        axis.plot(days, 1e3 * found.median, color=BLUE, label="median")
        tolerance = 1e3 * facts.goal.tolerance_um
        axis.axhline(tolerance, color=VERMILION, linestyle="--", linewidth=1, label=f"tolerance {tolerance:g} nm")
        axis.axvline(facts.now_h / _HOURS_PER_DAY, color="black", linestyle=":", linewidth=1, label="now")
        # What is far below the tolerance needs no room.
        least = min(tolerance / 50, 1e3 * float(found.median.min()) / 2)
        axis.set(yscale="log", xlabel="time [days]", ylabel="peak to peak of the\nworst task [nm]", ylim=(least, None))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.grid(alpha=0.3)
        figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return svg[0]


def drift_figure(facts: CampaignFacts, found: History) -> str:
    """The parameters of mirror and fibre through time."""
    assert facts.track is not None
    parameters = facts.track.drift.parameters
    chosen = [i for i, parameter in enumerate(parameters) if parameter.kind == "extrinsic"]
    n_rows = -(-len(chosen) // 3)
    with svg_figure(9.6, 0.7 + 2.2 * n_rows, panels=True) as (figure, svg):
        handles: dict[str, Any] = {}
        for number, i in enumerate(chosen, 1):
            axis = figure.add_subplot(n_rows, 3, number)
            _draw_track(axis, facts, found, i)
            axis.set(xlabel="time [days]", ylabel=f"{parameters[i].name} [{parameters[i].unit}]")
            handles |= {text: handle for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=4, frameon=False)
    return svg[0]


def _draw_track(axis: Any, facts: CampaignFacts, found: History, i: int) -> None:
    days, mean, sd = found.hours / _HOURS_PER_DAY, found.mean[:, i], found.sd[:, i]
    axis.fill_between(days, mean - 2 * sd, mean + 2 * sd, color=BLUE, alpha=0.2, linewidth=0, label="filter, 2 sd")
    axis.plot(days, mean, color=BLUE, linewidth=1)
    smooth_days = found.smooth_hours / _HOURS_PER_DAY
    axis.plot(smooth_days, found.smooth_mean[:, i], color=ORANGE, linestyle="--", linewidth=1.2, label="smoothed")
    if found.truth is not None and np.isfinite(found.truth[:, i]).any():
        axis.plot(days, found.truth[:, i], color="black", linewidth=1, linestyle=":", label="truth (simulated)")
    for n, (_, time_h, _) in enumerate(found.alarms):
        axis.axvline(time_h / _HOURS_PER_DAY, color=VERMILION, linewidth=1, label="alarm" if n == 0 else None)
    axis.axvline(facts.now_h / _HOURS_PER_DAY, color="black", linestyle=":", linewidth=0.8)
    # A session that is far off must not flatten the others.
    axis.set_ylim(np.min(mean - 2.6 * sd), np.max(mean + 2.6 * sd))
    axis.grid(alpha=0.3)


def residual_figure(parts: list[SessionResiduals]) -> str:
    """Residuals of the rows of all sessions in order, with a line between two sessions."""
    values = np.concatenate([part.values for part in parts])
    place, outside = np.arange(1, len(values) + 1), np.abs(values) > 3
    with svg_figure(9.6, 2.8) as (figure, svg):
        axis = figure.subplots()
        axis.axhspan(-2, 2, color=BLUE, alpha=0.12, linewidth=0)
        axis.plot(place[~outside], values[~outside], "o", color="black", markersize=2.5)
        axis.plot(place[outside], values[outside], "D", color=VERMILION, markersize=4)
        for end in np.cumsum([len(part.values) for part in parts])[:-1]:
            axis.axvline(end + 0.5, color=GREY, linewidth=0.6)
        axis.set(xlim=(0, len(values) + 1), xlabel="row, all sessions in order", ylabel="residual / sigma")
        axis.set_ylim(*(1.15 * max(3.2, np.abs(values).max()) * np.array([-1, 1])))
        axis.grid(axis="y", alpha=0.3)
    return svg[0]


def motion_figure(curves: list[MotionCurve]) -> str:
    """Error motions over the joint's value with bands, those that the calibration shows best."""
    drawn = curves[:_MOST_MOTIONS]
    if not drawn:
        return ""
    n_rows = -(-len(drawn) // 3)
    with svg_figure(9.6, 0.4 + 2.1 * n_rows, panels=True) as (figure, svg):
        for number, curve in enumerate(drawn, 1):
            axis = figure.add_subplot(n_rows, 3, number)
            axis.fill_between(curve.along, curve.low, curve.high, color=BLUE, alpha=0.25, linewidth=0)
            axis.plot(curve.along, curve.middle, color=BLUE)
            for side in (-2.0, 2.0):
                axis.plot(curve.along, side * curve.stated, color=GREY, linestyle="--", linewidth=0.8)
            axis.set_title(drawable(curve.name), fontsize=8, parse_math=False)
            axis.set_xlabel(f"[{curve.joint_unit}]", fontsize=7)
            axis.set_ylabel(f"[{curve.unit}]", fontsize=7)
            axis.tick_params(labelsize=7)
            axis.grid(alpha=0.3)
    return svg[0]


def prior_posterior_figure(parameters: ParameterSet, draws: Floats, before: Floats) -> Figure:
    """Densities of draws and of prior draws `before`, (.., n_parameters), over what the draws cover."""
    # ArviZ takes seconds to import: only figures pay for it.
    from arviz_stats.base import array_stats

    names = [f"{parameter.name} [{parameter.unit}]" for parameter in parameters]
    draws, before, rows = draws.reshape(-1, len(names)), before.reshape(-1, len(names)), -(-len(names) // _N_COLUMNS)
    figure = Figure(figsize=(11.0, 0.5 + 1.9 * rows), layout="constrained")
    axes = figure.subplots(rows, _N_COLUMNS, squeeze=False).ravel()
    for axis, name, own, prior in zip(axes, names, draws.T, before.T, strict=False):
        styles = {"prior": (prior, VERMILION, "--"), "posterior": (own, BLUE, "-")}
        for label, (values, colour, style) in styles.items():
            grid, density, _ = array_stats.kde(values[:: -(-values.size // _SHOWN_DRAWS)], grid_len=200)
            axis.plot(grid, density, style, color=colour, linewidth=1.4, label=label)
        low, high = np.quantile(own, [0.002, 0.998])
        axis.set(xlim=(low - 0.2 * (high - low), high + 0.2 * (high - low)), xlabel=name, yticks=[])
        axis.grid(alpha=0.3)
    for axis in axes[len(names) :]:
        axis.remove()
    figure.supylabel("density", fontsize="medium")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure
