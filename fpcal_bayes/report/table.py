"""Tables of an HTML page that sort by what a cell means, not by how it is written."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fpcal_bayes.report.observe import TextTable


@dataclass(frozen=True)
class Cell:
    """One cell.

    Attributes
    ----------
    text
        What stands in it; any text, it is escaped.
    key
        What the column sorts by; by default the text.
    style
        Name of a class of the style sheet, or empty.
    """

    text: str
    key: str = ""
    style: str = ""


@dataclass(frozen=True)
class PageTable:
    """A table.

    Attributes
    ----------
    caption
        Above it.
    columns
        Heads.
    rows
        As many cells each.
    words
        Positions of the columns that hold words; the others hold numbers and stand to the right.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    words: tuple[int, ...] = (0,)


def figure_of(value: float, text: str | None = None, style: str = "") -> Cell:
    """A number, which sorts by its value."""
    return Cell(f"{value:.3g}" if text is None else text, f"{value:.12g}" if np.isfinite(value) else "", style)


def table(
    caption: str, columns: Sequence[str], rows: Sequence[Sequence[Cell]], words: Sequence[int] = (0,)
) -> PageTable:
    """A table of cells."""
    return PageTable(caption, tuple(columns), tuple(tuple(row) for row in rows), tuple(words))


def of_text(content: TextTable, caption: str) -> PageTable:
    """A table of plain text; cells that begin with a number sort by it, and a status is coloured."""
    wordy = [i for i, name in enumerate(content.columns) if i < content.n_text or name == "strongest correlations"]
    rows = [
        [
            Cell(text, "" if i in wordy else _leading_number(text), _style(content.columns[i], text))
            for i, text in enumerate(row)
        ]
        for row in content.rows
    ]
    return table(caption, content.columns, rows, wordy)


def _leading_number(text: str) -> str:
    """The number of ``> 99.9 %`` and the like, or the text itself."""
    for word in text.split():
        try:
            return f"{float(word):.12g}"
        except ValueError:
            continue
    return text


def _style(column: str, text: str) -> str:
    return text if column == "status" else ""
