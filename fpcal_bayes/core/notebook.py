"""How results show themselves in a notebook."""

from collections.abc import Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.lazy import lazy

_load = lazy("fpcal_bayes.report", {"notebook": "shown write arviz_tree"})[1]


class Result:
    """A result that tells, tabulates, draws and writes itself, by `fpcal_bayes.report.notebook`, loaded when asked."""

    def _view(self) -> Any:
        return _load("shown")(self)

    def summary(self) -> str:
        """The tables and sentences that the command of the same kind prints."""
        return str(self._view().summary())

    def to_dataframe(self) -> Any:
        """The numbers as a pandas DataFrame, in the units a person reads; columns say other ones."""
        return self._view().frame

    def plot(self) -> Any:
        """A matplotlib Figure of it."""
        return self._view().draw()

    def write(self, path: str | Path) -> None:
        """Write the file that the command of the same kind writes: JSON, or netCDF where `path` ends in ``.nc``."""
        _load("write")(self, Path(path))

    def to_arviz(self) -> Any:
        """The draws of a posterior as an ArviZ DataTree; `InputError` if the result has no draws."""
        return _load("arviz_tree")(self)

    def _repr_html_(self) -> str:
        return str(self._view().html())


class Brief:
    """A dataclass, made with ``repr=False``, that shows of arrays the shape and of the rest what is short."""

    def __repr__(self) -> str:
        told = (f"{each.name}={_brief(getattr(self, each.name))}" for each in fields(self))  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(told)})"


def _brief(value: object) -> str:
    """A value in 80 characters at most."""
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    text = repr(value)
    return text if len(text) <= 80 else f"{type(value).__name__}(...)"


def html_table(caption: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table as HTML; every text is escaped."""
    head = "".join(f"<th>{escape(str(column))}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
