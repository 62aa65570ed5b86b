"""Figures as SVG text to stand in a page: colours, settings, and the writer that all pages share."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.figure import Figure

# Okabe and Ito's colours, told apart by colour-blind readers and in grey print.
BLUE, ORANGE, GREEN, VERMILION, PURPLE, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#666666"
SETTINGS: dict[Any, Any] = {"svg.hashsalt": "fpcal", "font.size": 9, "hatch.linewidth": 0.6, "axes.axisbelow": True}
_MOST_CHARACTERS = 24


@contextmanager
def svg_figure(width: float, height: float) -> Iterator[tuple[Figure, list[str]]]:
    """A figure of a size in inches to draw on; its SVG is in the list after the block."""
    svg: list[str] = []
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, svg
        svg.append(svg_text(figure))


def svg_text(figure: Figure) -> str:
    """The SVG element of a figure; the same figure gives the same text."""
    buffer = io.StringIO()
    with matplotlib.rc_context(SETTINGS):
        # The date would make two runs differ.
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    # The page decides the size; the view box keeps the proportions.
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    return "\n".join(line for line in text.splitlines() if line.strip())


def drawable(text: str) -> str:
    """A text that the font can draw, not too long for an axis."""
    known = "".join(c if c.isprintable() and ord(c) < 0x250 else "?" for c in text)
    return known if len(known) <= _MOST_CHARACTERS else known[: _MOST_CHARACTERS - 3] + "..."
