"""An observability analysis in sentences and tables, on a terminal and as one page that needs nothing else."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from rich.console import Console

from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.version import __version__
from fpcal_bayes.infer.fit.spectrum import GAUGE_SHARE, WEAK_SHARE
from fpcal_bayes.infer.observability.gauges import Gauge
from fpcal_bayes.infer.observability.information import REDUNDANT_BITS
from fpcal_bayes.infer.observability.observe import Observability
from fpcal_bayes.report import observe_figures as figures
from fpcal_bayes.report.pages import ENVIRONMENT
from fpcal_bayes.report.table import Table, TableCell, number, plain_table

_MOST_NAMED = 10
_MOST_CANDIDATES = 5
_MOST_SWEEPS = 8
_LEAST_CORRELATION = 0.3


def headline(result: Observability) -> list[str]:
    """How many combinations are seen, how clearly, and at which point this was found."""
    spectrum, n = result.spectrum, len(result.parameters)
    if spectrum.rank == n:
        sentence = f"All {n} combinations are seen"
    else:
        gap = "nothing" if spectrum.gap == np.inf else f"10^{np.log10(spectrum.gap):.0f}"
        clear = "a clear gap" if spectrum.gap >= 1e3 else "NO clear gap"
        sentence = f"{spectrum.rank} of {n} combinations are seen; {clear} of {gap} sets them off from the others"
        if spectrum.gap == np.inf:
            sentence = f"{spectrum.rank} of {n} combinations are seen; the others leave no trace at all"
    if spectrum.rank:
        sentence += f"; condition number of the seen ones {result.indices.condition:.3g}"
    counts = [f"{sum(s == kind for s in result.status)} {kind}" for kind in ("identified", "weak", "gauge")]
    where = (
        f"Linearised at {len(result.ranks)} draws of the prior (a plan: standard deviations are those to be expected)."
        if result.identification is None
        else "Linearised at the maximum of the posterior of the measured sweeps."
    )
    if len(set(result.ranks)) > 1:
        where += f" The rank differs between the draws: {min(result.ranks)} to {max(result.ranks)}."
    return [
        sentence + ".",
        f"Parameters: {', '.join(counts)}. A gauge stands by more than {100 * GAUGE_SHARE:.0f} % in directions that "
        f"nothing sees; weak means that more than {100 * WEAK_SHARE:g} % of the prior variance is left.",
        f"{counted(len(result.sweeps), 'row')}, {counted(len(result.information.labels), 'sweep')}; "
        f"path model {result.cell.opd}. {where}",
    ]


def parameter_table(result: Observability) -> Table:
    """Each parameter: value if measured, standard deviations, contraction, status, strongest correlations."""
    measured = result.identification is not None
    parameters = result.parameters
    values = parameters.to_shown(result.values)
    sds = parameters.to_shown(np.sqrt(np.diag(result.covariance)) * parameters.prior_sd)
    prior = parameters.to_shown(parameters.prior_sd)
    heads = ["parameter", "unit", "status", *(["value", "sd"] if measured else ["expected sd"])]
    heads += ["prior sd", "contraction", "strongest correlations"]
    table = plain_table("Parameters", heads, words=(0, 1, 2, -1))
    for i, parameter in enumerate(parameters):
        strong = [(n, c) for n, c in result.strongest_correlations(parameter.name, 2) if abs(c) >= _LEAST_CORRELATION]
        table.add_row(
            parameter.name,
            parameter.unit,
            TableCell(result.status[i], style=result.status[i]),
            *([number(float(values[i]), float(sds[i]))] if measured else []),
            number(float(sds[i]), float(sds[i])),
            f"{prior[i]:g}",
            percent(float(result.contraction[i])),
            ", ".join(f"{name} {correlation:+.2f}" for name, correlation in strong),
        )
    return table


def percent(share: float) -> str:
    """A share from 0 to 1 as a percentage; one and zero are kept for what is exact within rounding."""
    return "> 99.9 %" if share > 0.9995 else f"{100 * max(share, 0.0):.1f} %"


def gauge_sentence(gauge: Gauge) -> str:
    """Cause and remedy of one unseen direction."""
    none = "none, and none is needed: " if gauge.layer == "model" else ""
    told = gauge.explanation
    # Names of parameters stay as they are.
    capital = told[0] if "_" in told.split(maxsplit=1)[0] else told[0].upper()
    return f"{capital}{told[1:]}. Remedy: {none}{gauge.remedy}."


def gauge_direction(gauge: Gauge, result: Observability) -> str:
    """How far each parameter moves along one unseen direction."""
    moves = zip(gauge.parameters, gauge.direction, strict=True)
    return shortened([f"{name} {move:+.4g} {result.parameters[name].unit}" for name, move in moves], 6)


def base_sentence(result: Observability) -> str:
    """What the base parameters are."""
    if not result.base:
        return "The data determine nothing, so there is no base parameter."
    return (
        f"The data determine these {len(result.base)} combinations and no others; a parameter that is regrouped into "
        "others may be held at any value."
    )


def block_table(result: Observability) -> Table:
    """Rank and observability indices of the sweeps, of their parts, and with additions."""
    heads = ["sweeps", "rows", "rank", "condition", "O1", "O2", "O3", "O4", "O5"]
    table = plain_table("What parts of the sweeps tell, and what additions would", heads, words=[0])
    for block in result.blocks:
        condition = f"{block.indices.condition:.3g}" if block.spectrum.rank else "-"
        indices = [f"{value:.3g}" for value in block.indices.content().values()]
        table.add_row(block.name, *map(_sortable, [str(block.n_rows), str(block.spectrum.rank), condition, *indices]))
    return table


def _sortable(text: str) -> TableCell:
    """A number that sorts by what is shown of it."""
    try:
        return TableCell(text, f"{float(text):.12g}")
    except ValueError:
        return TableCell(text, text)


def sweep_table(result: Observability) -> Table:
    """The sweeps that tell most."""
    information = result.information
    table = plain_table("Sweeps that tell most", ["sweep", "bits lost without it", "leverage"], words=[0])
    for i in np.argsort(-information.bits, kind="stable")[:_MOST_SWEEPS]:
        table.add_row(information.labels[i], f"{information.bits[i]:.2f}", f"{information.leverage[i]:.2f}")
    return table


def information_sentences(result: Observability) -> list[str]:
    """What the sweeps tell together, which are redundant, which additions would tell most."""
    information = result.information
    total = float(information.cumulative_bits[-1])
    sentences = [
        f"Together the sweeps tell {total:.1f} bits: the volume of what is possible shrinks by a factor 2^{total:.0f}."
    ]
    redundant = information.redundant
    if redundant:
        sentences.append(
            f"{counted(len(redundant), 'sweep')} could be left out, each alone, at a loss of less than "
            f"{REDUNDANT_BITS:g} bits: {shortened(redundant, _MOST_NAMED)}."
        )
    else:
        sentences.append(f"No sweep is redundant: leaving out any one of them loses {REDUNDANT_BITS:g} bits or more.")
    best = [f"{label} (+{bits:.2f} bits)" for label, bits in result.candidates[:_MOST_CANDIDATES]]
    if best:
        sentences.append(f"Best additions, each counted alone: {', '.join(best)}.")
    return sentences


def bounds_table(result: Observability) -> Table:
    """Cramer-Rao bounds by what is identified; the others are taken as known exactly."""
    names = {"full": "all", "extrinsic": "extrinsic only", "intrinsic": "intrinsic only"}
    chosen = [free for free in names if free in result.bounds]
    heads = ["parameter", "unit", *(head for free in chosen for head in (names[free], "with prior"))]
    table = plain_table("Cramer-Rao bounds: least standard deviations, by what is identified", heads)
    for parameter in result.parameters:
        cells = [parameter.name, parameter.unit]
        for free in chosen:
            parameters, bounds = result.bounds[free]
            if parameter.name not in parameters:
                cells += ["", ""]
                continue
            at, scale = parameters.position(parameter.name), parameter.shown(parameter.prior_sd)
            unbiased, with_prior = float(bounds.unbiased[at]) * scale, float(bounds.with_prior[at]) * scale
            cells += ["unbounded" if unbiased == np.inf else f"{unbiased:.3g}", f"{with_prior:.3g}"]
        table.add_row(*cells)
    return table


def shortened(names: Sequence[str], most: int) -> str:
    """Names in a row, the first `most` of them."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def mechanics_sentences(result: Observability) -> list[str]:
    """What the rows say of the stated error motions, and which terms the residuals show most."""
    if result.mechanics is None:
        return []
    known = result.mechanics["scales"].items()
    scales = [f"{name} {one['median']:.2g} ({one['low']:.2g} .. {one['high']:.2g})" for name, one in known]
    tests = [f"{test['term']} (p = {test['p_value']:.2g})" for test in result.mechanics["tests"][:3]]
    return [
        "",
        f"Mechanics, times the stated size: {', '.join(scales)}",
        f"Terms that the residuals show most: {', '.join(tests)}",
    ]


def print_observability(result: Observability, title: str, out: Console) -> None:
    """Print what sweeps can tell about a cell; the title, file and session, is not taken as markup."""

    def lines(*sentences: str) -> None:
        for sentence in sentences:
            out.print(sentence, markup=False, soft_wrap=True)

    lines(title, *headline(result), "")
    out.print(parameter_table(result))
    lines("Directions that the data do not see")
    for gauge in result.gauges:
        lines(f"- {gauge_sentence(gauge)}", f"    moves: {gauge_direction(gauge, result)}")
    if not result.gauges:
        lines("- none")
    lines(*mechanics_sentences(result))
    lines("", "Base parameters", base_sentence(result))
    lines(*(f"- {base}" for base in result.base), "")
    out.print(block_table(result))
    out.print(sweep_table(result))
    lines(*information_sentences(result), "")
    out.print(bounds_table(result))


def observe_html(result: Observability, title: str) -> str:
    """A page with text, tables and figures; the same analysis gives the same text."""
    drawn = {
        "spectrum": figures.spectrum_figure(result),
        "contraction": figures.contraction_figure(result),
        "correlation": figures.correlation_figure(result),
        "information": figures.information_figure(result),
    }
    return ENVIRONMENT.get_template("observe.html").render(
        title=title,
        version=__version__,
        cell=result.cell,
        headline=headline(result),
        warnings=result.warnings,
        parameters=parameter_table(result),
        gauges=[(gauge_sentence(gauge), gauge_direction(gauge, result)) for gauge in result.gauges],
        base=base_sentence(result),
        base_parameters=[str(base) for base in result.base],
        blocks=block_table(result),
        sweeps=sweep_table(result),
        information=information_sentences(result),
        bounds=bounds_table(result),
        # Drawn here, and their texts escaped by the SVG writer.
        figures={name: Markup(svg) for name, svg in drawn.items()},
    )
