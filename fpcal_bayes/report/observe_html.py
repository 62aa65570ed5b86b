"""An observability analysis as one page that needs nothing else."""

from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from fpcal_bayes import __version__
from fpcal_bayes.files import write_text
from fpcal_bayes.infer.observe import Observability
from fpcal_bayes.report import observe_figures as figures
from fpcal_bayes.report import observe_words as words


def write_observe_html(result: Observability, title: str, path: Path) -> None:
    """Write a page with text, tables and figures; the same analysis gives the same bytes.

    Parameters
    ----------
    title
        What was analysed: file and session. Any text: it is escaped.
    path
        Of the HTML file.
    """
    write_text(path, observe_html(result, title))


def observe_html(result: Observability, title: str) -> str:
    """The page as text."""
    environment = Environment(
        loader=PackageLoader("fpcal_bayes.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    drawn = {
        "spectrum": figures.spectrum_figure(result),
        "contraction": figures.contraction_figure(result),
        "correlation": figures.correlation_figure(result),
        "information": figures.information_figure(result),
        "profiles": figures.profile_figure(result) if result.profiles else "",
    }
    return environment.get_template("observe.html").render(
        title=title,
        version=__version__,
        cell=result.cell,
        headline=words.headline(result),
        warnings=result.warnings,
        parameters=words.parameter_table(result),
        gauges=[(words.gauge_sentence(g), words.gauge_direction(g, result)) for g in result.gauges],
        base=words.base_sentence(result),
        base_parameters=[str(base) for base in result.base],
        blocks=words.block_table(result),
        sweeps=words.sweep_table(result),
        information=words.information_sentences(result),
        bounds=words.bounds_table(result),
        profiles=[words.profile_sentence(profile, result) for profile in result.profiles],
        # Drawn here, and their texts escaped by the SVG writer.
        figures={name: Markup(svg) for name, svg in drawn.items()},
    )
