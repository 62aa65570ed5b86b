"""The table of every report: one content that a terminal, a page and plain text show.

A page shows it by the macro `table` of ``templates/macros.html``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import StringIO

import numpy as np
from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markup import escape
from rich.table import Table as TerminalTable
from rich.text import Text

#: Characters of a line in a pipe or a file, which have no width: nothing is cut or broken there.
ANY_WIDTH = 100_000
#: Colours of the terminal; on a page the style is a class of the style sheet.
_COLOURS = {
    "identified": "green",
    "weak": "yellow",
    "gauge": "red",
    "fixed": "dim",
    "good": "green",
    "caution": "yellow",
    "bad": "red",
}


@dataclass(frozen=True)
class Column:
    """Name and unit at the head of a column, and whether it holds words: numbers stand to the right."""

    name: str
    unit: str = ""
    words: bool = False


@dataclass(frozen=True)
class TableCell:
    """Any text, what the column sorts by on a page (the text, if empty), and a style such as ``good``, or none."""

    text: str
    key: str = ""
    style: str = ""


@dataclass
class Table:
    """Rows under a title and the heads of the columns."""

    title: str
    columns: list[Column]
    rows: list[list[TableCell]] = field(default_factory=list)

    def add_row(self, *cells: str | TableCell) -> None:
        """Append a row of as many cells as there are columns."""
        self.rows.append([cell if isinstance(cell, TableCell) else TableCell(cell) for cell in cells])

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        # Rich would break a title that is wider than its table.
        yield Text(self.title, style="table.title", overflow="fold")
        shown = TerminalTable(box=box.SIMPLE_HEAD, pad_edge=False)
        for column in self.columns:
            head = f"{column.name} {column.unit}".rstrip()
            shown.add_column(escape(head), justify="left" if column.words else "right", no_wrap=True)
        for row in self.rows:
            styled = [(escape(cell.text), _COLOURS.get(cell.style)) for cell in row]
            shown.add_row(*(f"[{style}]{text}[/{style}]" if style else text for text, style in styled))
        yield shown

    def __str__(self) -> str:
        text = StringIO()
        Console(file=text, width=ANY_WIDTH, color_system=None).print(self)
        return text.getvalue()


def plain_table(title: str, heads: Sequence[str], words: Sequence[int] = (0, 1)) -> Table:
    """An empty table under heads such as ``size [nm]``; `words` are the columns that hold no numbers."""
    texts = {i % len(heads) for i in words}
    parts = [head.removesuffix("]").partition(" [") for head in heads]
    return Table(title, [Column(name, unit, i in texts) for i, (name, _, unit) in enumerate(parts)])


def figure_of(value: float, text: str | None = None, style: str = "") -> TableCell:
    """A number, which sorts by its value."""
    return TableCell(f"{value:.3g}" if text is None else text, f"{value:.12g}" if math.isfinite(value) else "", style)


def number(value: float, sd: float) -> str:
    """Write a value with two significant digits of its standard deviation (at most six decimals)."""
    if not np.isfinite(sd) or sd <= 0:
        return f"{value:.6g}"
    decimals = int(np.clip(1 - np.floor(np.log10(sd)), 0, 6))
    # Adding zero turns -0 into 0.
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
