"""An observability analysis as text for the terminal."""

from rich.console import Console
from rich.markup import escape

from fpcal_bayes.infer.observe import Observability
from fpcal_bayes.report import observe_words as words
from fpcal_bayes.report.tables import STATUS_STYLES, plain_table


def print_observability(result: Observability, title: str, out: Console) -> None:
    """Print what sweeps can tell about a cell.

    Parameters
    ----------
    title
        What was analysed: file and session. Any text: nothing in it is taken as markup.
    out
        Where to print; a quiet console prints nothing.
    """

    def lines(*sentences: str) -> None:
        for sentence in sentences:
            out.print(sentence, markup=False, soft_wrap=True)

    def table(heading: str, content: words.TextTable) -> None:
        made = plain_table(heading, content.columns)
        for i, column in enumerate(made.columns):
            # Correlations are words at the end of a row.
            wordy = i < content.n_text or content.columns[i] == "strongest correlations"
            column.justify = "left" if wordy else "right"
        for row in content.rows:
            made.add_row(*(_styled(cell) for cell in row))
        out.print(made)

    lines(title, *words.headline(result), "")
    table("Parameters", words.parameter_table(result))
    lines("Directions that the data do not see")
    for gauge in result.gauges:
        lines(f"- {words.gauge_sentence(gauge)}", f"    moves: {words.gauge_direction(gauge, result)}")
    if not result.gauges:
        lines("- none")
    lines("", "Base parameters", words.base_sentence(result))
    lines(*(f"- {base}" for base in result.base), "")
    table("What parts of the sweeps tell, and what additions would", words.block_table(result))
    table("Sweeps that tell most", words.sweep_table(result))
    lines(*words.information_sentences(result), "")
    table("Cramer-Rao bounds: least standard deviations, by what is identified", words.bounds_table(result))
    if result.profiles:
        lines("Profile likelihoods")
        lines(*(f"- {words.profile_sentence(profile, result)}" for profile in result.profiles), "")


def _styled(cell: str) -> str:
    style = STATUS_STYLES.get(cell)
    return f"[{style}]{cell}[/{style}]" if style else escape(cell)
