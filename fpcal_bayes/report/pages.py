"""What the pages share: one Jinja environment, and figures as SVG text to stand in a page or as files."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from fpcal_bayes.core.files import replacing

# Okabe and Ito's colours, told apart by colour-blind readers and in grey print.
BLUE, ORANGE, GREEN, VERMILION, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#666666"
SKY = "#56B4E9"
_SETTINGS: dict[Any, Any] = {"svg.hashsalt": "fpcal", "font.size": 9, "hatch.linewidth": 0.6, "axes.axisbelow": True}
_MOST_CHARACTERS = 24

#: Of all pages; whatever is not marked as safe is escaped.
ENVIRONMENT = Environment(
    loader=PackageLoader("fpcal_bayes.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


def packaged(folder: str, name: str) -> str:
    """Text of a file that stands in a folder beside the templates."""
    return files("fpcal_bayes.report").joinpath(folder, name).read_text(encoding="utf-8")


@contextmanager
def svg_figure(width: float, height: float, *, panels: bool = False) -> Iterator[tuple[Figure, list[str]]]:
    """A figure of a size in inches to draw on; its SVG, or that of its panels, is in the list after the block."""
    svg: list[str] = []
    with matplotlib.rc_context(_SETTINGS):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, svg
        svg.append(svg_panels(figure) if panels else svg_text(figure))


def svg_panels(figure: Figure) -> str:
    """The legend and each panel of a figure as SVG elements of their own, which a narrow page sets in a column."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    parts, inches = [*figure.legends, *figure.axes], figure.dpi_scale_trans.inverted()
    boxes = [np.array(inches.transform(part.get_tightbbox())) for part in parts]  # type: ignore[arg-type]
    # All panels keep the same room around their axes, so that their letters have one size.
    n = len(figure.legends)
    inner = np.array([inches.transform(axis.bbox) for axis in figure.axes])
    boxes[n:] = inner + (np.abs(boxes[n:] - inner).max(axis=0) + 0.02) * [[-1.0], [1.0]]
    svg = ""
    for part, box in zip(parts, boxes, strict=True):
        for each in parts:
            each.set_visible(each is part)
        svg += svg_text(figure, Bbox(box)).replace("<svg", '<svg class="legend"' if part in parts[:n] else "<svg", 1)
    return svg


def svg_text(figure: Figure, box: Bbox | None = None) -> str:
    """The SVG element of a figure, or of a box in it in inches; the same figure gives the same text."""
    buffer = io.StringIO()
    with matplotlib.rc_context(_SETTINGS):
        # The date would make two runs differ.
        figure.savefig(buffer, format="svg", bbox_inches=box, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    # The page decides the size; the view box keeps the proportions.
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    return "\n".join(line for line in text.splitlines() if line.strip())


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG or PNG by the suffix of `path`; the same figure gives the same bytes."""
    with matplotlib.rc_context({"svg.hashsalt": "fpcal"}), replacing(path) as temporary:
        kind = path.suffix.lstrip(".")
        # The date would make two runs differ.
        figure.savefig(temporary, format=kind, dpi=130, metadata={"Date" if kind == "svg" else "Software": None})


def drawable(text: str) -> str:
    """A text that the font can draw, not too long for an axis."""
    known = "".join(c if c.isprintable() and ord(c) < 0x250 else "?" for c in text)
    return known if len(known) <= _MOST_CHARACTERS else known[: _MOST_CHARACTERS - 3] + "..."
