"""The extrinsic parameters through the week: true, identified as the paper did, and followed."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.files import replacing
from fpcal_bayes.model.parameters import Parameter
from fpcal_bayes.track.drift import DriftModel
from fpcal_bayes.track.filter import predict
from fpcal_bayes.track.step import SessionOutcome
from fpcal_bayes.week import SESSIONS, Week
from fpcal_bayes.week_courses import Followed

# Okabe and Ito's colours, told apart by colour-blind readers and in grey print.
_TRUTH, _FULL, _EXTRINSIC = "#000000", "#0072B2", "#D55E00"
_POLICY, _FILTER = "#009E73", "#CC79A7"
#: Times at which a band is drawn between two sessions, both included.
_BETWEEN = 4


def draw_week(week: Week, followed: Followed | None = None) -> Figure:
    """Draw each extrinsic parameter against time: truth, estimates, and two standard deviations of each.

    Parameters
    ----------
    followed
        Filter and policy, whose bands are drawn too.
    """
    parameters = [p for p in week.cell.free if p.kind == "extrinsic"]
    figure = Figure(figsize=(10, 7.5), layout="constrained")
    axes = figure.subplots(-(-len(parameters) // 2), 2, squeeze=False, sharex=True)
    hours = np.linspace(0.0, 24.0 * SESSIONS[-1].day, 200)
    truth = week.truth.parameters.to_shown(week.truth.at(hours))
    for axis, parameter in zip(axes.flat, parameters, strict=False):
        true = truth[:, week.truth.parameters.position(parameter.name)]
        if followed is not None:
            drift = followed.track.drift
            days, low, high = _band(drift, parameter, followed.loop.outcomes, hours[-1])
            axis.fill_between(days, low, high, color=_POLICY, alpha=0.25, linewidth=0, label="policy")
            days, low, high = _band(drift, parameter, followed.track.outcomes, hours[-1])
            axis.plot(days, low, "--", color=_FILTER, linewidth=0.8, label="filter, the same sweeps")
            axis.plot(days, high, "--", color=_FILTER, linewidth=0.8)
        axis.plot(hours / 24.0, true, color=_TRUTH, linewidth=1, label="truth")
        for kind, colour, marker in (("all", _FULL, "o"), ("extrinsic", _EXTRINSIC, "s")):
            chosen = [s for s in SESSIONS if s.free == kind]
            shown = [week.identifications[s.name].estimate.shown()[parameter.name] for s in chosen]
            axis.errorbar(
                [s.day for s in chosen],
                [entry["value"] for entry in shown],
                [2 * entry["sd"] for entry in shown],
                fmt=marker,
                color=colour,
                markersize=4,
                capsize=3,
                linewidth=1,
                label="full identification" if kind == "all" else "extrinsic only, day-2 intrinsics",
            )
        axis.set_ylabel(parameter.latex)
        axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("time [days]")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9
    )
    return figure


def _band(
    drift: DriftModel, parameter: Parameter, outcomes: Sequence[SessionOutcome], end_h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Days, and two standard deviations to either side of what was known then, in the units a person reads."""
    at = drift.parameters.position(parameter.name)
    until = [outcome.time_h for outcome in outcomes[1:]] + [max(end_h, outcomes[-1].time_h)]
    points = []
    for outcome, end in zip(outcomes, until, strict=True):
        for time_h in np.linspace(outcome.time_h, end, _BETWEEN):
            state = predict(drift, outcome.state, float(time_h))
            mean, variance = drift.values(state.mean)[at], drift.covariance(state.covariance)[at, at]
            points.append((time_h / 24.0, mean, 2.0 * np.sqrt(variance)))
    days, mean, width = np.array(points).T
    return days, (mean - width) / parameter.scale, (mean + width) / parameter.scale


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG or PNG by the suffix of `path`; the same figure gives the same bytes."""
    with matplotlib.rc_context({"svg.hashsalt": "fpcal"}), replacing(path) as temporary:
        kind = path.suffix.lstrip(".")
        # The date would make two runs differ.
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(temporary, format=kind, dpi=130, metadata=metadata)
