"""The extrinsic parameters through the week, identified and true."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.files import replacing
from fpcal_bayes.week import SESSIONS, Week

# Okabe and Ito's colours, told apart by colour-blind readers and in grey print.
_TRUTH, _FULL, _EXTRINSIC = "#000000", "#0072B2", "#D55E00"


def draw_week(week: Week) -> Figure:
    """Draw each extrinsic parameter against time: truth, estimates, and two standard deviations of each."""
    parameters = [p for p in week.cell.free if p.kind == "extrinsic"]
    figure = Figure(figsize=(10, 7.5), layout="constrained")
    axes = figure.subplots(-(-len(parameters) // 2), 2, squeeze=False, sharex=True)
    hours = np.linspace(0.0, 24.0 * SESSIONS[-1].day, 200)
    truth = week.truth.parameters.to_shown(week.truth.at(hours))
    for axis, parameter in zip(axes.flat, parameters, strict=False):
        true = truth[:, week.truth.parameters.position(parameter.name)]
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
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG or PNG by the suffix of `path`; the same figure gives the same bytes."""
    with matplotlib.rc_context({"svg.hashsalt": "fpcal"}), replacing(path) as temporary:
        kind = path.suffix.lstrip(".")
        # The date would make two runs differ.
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(temporary, format=kind, dpi=130, metadata=metadata)
