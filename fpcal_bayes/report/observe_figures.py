"""Figures of an observability analysis, as SVG text to stand in a page."""

import numpy as np
from matplotlib.ticker import MaxNLocator

from fpcal_bayes.infer.fit.spectrum import WEAK_SHARE, Status
from fpcal_bayes.infer.observability.observe import Observability
from fpcal_bayes.report.pages import BLUE, GREY, ORANGE, VERMILION, drawable, svg_figure

# Hatches and markers tell the same as colours in grey print.
_STATUS: dict[Status, tuple[str, str]] = {
    "identified": (BLUE, ""),
    "weak": (ORANGE, "///"),
    "gauge": (VERMILION, "xxx"),
    "fixed": (GREY, "..."),
}
_MOST_LABELS = 80
_MOST_BARS = 200


def spectrum_figure(result: Observability) -> str:
    """Singular values on a logarithmic scale, with rank and tolerance."""
    with svg_figure(7.2, 3.6) as (figure, svg):
        axis = figure.subplots()
        spectrum, n = result.spectrum, len(result.parameters)
        number = np.arange(1, n + 1)
        # Exact zeros have no place on the scale: they stand at its foot.
        values = np.maximum(spectrum.singular_values, 1e-18 * max(float(spectrum.singular_values[0]), 1e-300))
        seen = number <= spectrum.rank
        axis.semilogy(number[seen], values[seen], "o", color=BLUE, label=f"seen ({spectrum.rank})")
        if not seen.all():
            label = f"not seen ({n - spectrum.rank})"
            axis.semilogy(number[~seen], values[~seen], "v", color=VERMILION, fillstyle="none", label=label)
            axis.axvline(spectrum.rank + 0.5, color=GREY, linewidth=0.8)
        axis.axhline(1.0, color=GREY, linestyle=":", label="data tell as much as the prior")
        if spectrum.tolerance > 0:
            axis.axhline(spectrum.tolerance, color="black", linestyle="--", linewidth=1, label="tolerance of the rank")
        axis.set(xlabel="direction, best seen first", ylabel="singular value\n[prior sd / noise sd]")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.grid(alpha=0.3)
        figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return svg[0]


def contraction_figure(result: Observability) -> str:
    """How much of each parameter's prior variance the data take away."""
    n = len(result.parameters)
    with svg_figure(7.2, 1.2 + 0.21 * n) as (figure, svg):
        axis = figure.subplots()
        place = np.arange(n)
        for status, (colour, hatch) in _STATUS.items():
            chosen = np.array([s == status for s in result.status])
            if chosen.any():
                share = 100 * np.clip(result.contraction[chosen], 0.0, 1.0)
                bars = axis.barh(place[chosen], share, color=colour, hatch=hatch, edgecolor="white", label=status)
                labels = [f"{s:.1f}" if s < 99.95 else "> 99.9" for s in share]
                axis.bar_label(bars, labels, padding=2, fontsize=7, bbox={"color": "white", "pad": 0.5})
        axis.axvline(100 * (1 - WEAK_SHARE), color="black", linestyle="--", linewidth=1, label="limit of weak")
        marks = ["" if status == "identified" else f" ({status})" for status in result.status]
        axis.set_yticks(place, [name + mark for name, mark in zip(result.parameters.names, marks, strict=True)])
        axis.set(ylim=(n - 0.4, -0.6), xlim=(0, 112), xticks=np.arange(0, 101, 20))
        axis.set_xlabel("prior variance that the data take away [%]")
        axis.grid(axis="x", alpha=0.3)
        figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return svg[0]


def correlation_figure(result: Observability) -> str:
    """Correlations of the posterior."""
    n = len(result.parameters)
    side = 2.2 + 0.24 * n
    with svg_figure(side + 0.8, side) as (figure, svg):
        axis = figure.subplots()
        edges = np.arange(n + 1) - 0.5
        mesh = axis.pcolormesh(edges, edges, result.correlation, cmap="PuOr", vmin=-1.0, vmax=1.0)
        axis.set_xticks(np.arange(n), result.parameters.names, rotation=90)
        axis.set_yticks(np.arange(n), result.parameters.names)
        axis.set(ylim=(n - 0.5, -0.5), aspect="equal", xlabel="parameter", ylabel="parameter")
        bar = figure.colorbar(mesh, label="correlation [1]", shrink=0.8)
        # Else the bar is a bitmap.
        if bar.solids is not None:
            bar.solids.set_rasterized(False)
    return svg[0]


def information_figure(result: Observability) -> str:
    """Information lost without each sweep, in the order of measurement, and its growth."""
    information = result.information
    n = len(information.labels)
    with svg_figure(9.6, 6.0) as (figure, svg):
        single, grown = figure.subplots(2, 1)
        if n <= _MOST_BARS:
            single.bar(np.arange(n), information.bits, color=BLUE)
        else:
            single.plot(information.bits, color=BLUE, linewidth=0.8)
        single.set(xlim=(-0.6, n - 0.4), ylabel="information lost\nwithout the sweep [bits]")
        if n <= _MOST_LABELS:
            labels = [drawable(label) for label in information.labels]
            single.set_xticks(np.arange(n), labels, rotation=90, fontsize=7 if n > 40 else 8, parse_math=False)
        else:
            single.set_xlabel("sweep, in order of measurement")
        grown.plot(information.cumulative_rows, information.cumulative_bits, color=VERMILION)
        grown.set(xlim=(0, int(information.cumulative_rows[-1])), ylim=(0, None))
        grown.set(xlabel="first so many rows [1]", ylabel="information together [bits]")
        single.grid(axis="y", alpha=0.3)
        grown.grid(alpha=0.3)
    return svg[0]
