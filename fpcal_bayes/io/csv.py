"""CSV files: records of named columns, plain tables of numbers, and writing."""

import csv
import io
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import read_text, require_line_end, write_text
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.io.validate import shown

# float() reads more than a file should hold (1_000, infinity, digits of other scripts). Of texts made of these
# characters it reads decimal and scientific notation only.
_NUMBER_CHARACTERS = frozenset("0123456789+-.eE")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")

#: Digits written: 1e-9 um of a cavity length and 1e-12 of an angle survive, the noise of deg to rad and back does not.
_DIGITS = 13

#: Fields of fewer characters repeat in many rows.
_SHORT = 9

#: Samples of one file of numbers; a longer one is no sweep.
MAX_SAMPLES = 20_000_000


@dataclass(frozen=True)
class Records:
    """The lines of a CSV file that are not blank: a header, which is empty where there is none, and rows of texts."""

    path: Path
    header: list[str]
    header_row: int
    texts: list[list[str]]
    rows: Ints  # line of each row, shape (n,)

    def require_header(self, names: Sequence[str], others: Sequence[str] = ()) -> None:
        """Raise `InputError` unless the header is `names`, then any of `others`."""
        if self.header[: len(names)] != list(names) or not set(self.header[len(names) :]) <= set(others):
            then = f", then any of {','.join(others)}" if others else ""
            found = shown(",".join(self.header))
            raise located(self.path, f"expected the header {','.join(names)}{then}, found {found}", row=self.header_row)

    def columns(self) -> dict[str, tuple[str, ...]]:
        """The texts of each column; `InputError` if a row has more or fewer fields than the header."""
        for fields, row in zip(self.texts, self.rows.tolist(), strict=True):
            if len(fields) != len(self.header):
                raise located(self.path, f"expected {len(self.header)} fields, found {len(fields)}", row=row)
        columns = zip(*self.texts, strict=True) if self.texts else [()] * len(self.header)
        return dict(zip(self.header, columns, strict=True))

    def numbers(
        self, name: str, texts: Sequence[str], *, finite: bool = False, expected: str = "expected a number"
    ) -> Floats:
        """The numbers of column `name`; `InputError` that names the line of the first text that is none."""
        if _NUMBER_CHARACTERS.issuperset("".join(texts)) and "" not in texts:
            with suppress(ValueError):
                numbers = np.array(list(map(float, texts)))
                if not finite or np.isfinite(numbers).all():
                    return numbers
        is_one = [_NUMBER.fullmatch(text) and not (finite and np.isinf(float(text))) for text in texts]
        first = next(i for i, good in enumerate(is_one) if not good)
        if _NUMBER.fullmatch(texts[first]):
            expected = "expected a finite number"
        found = f"found {shown(texts[first])}" if texts[first] else "found nothing"
        raise located(self.path, f"{expected}, {found}", row=int(self.rows[first]), column=name)


def read_records(path: Path, expected: str = "", text: str | None = None) -> Records:
    """The records of a CSV file, or of its `text`; `InputError`, with what was `expected`, where no line holds text."""
    return next(read_blocks(path, expected, text, sys.maxsize))


def read_blocks(path: Path, expected: str, text: str | None, most: int) -> Iterator[Records]:
    """The records of a CSV file as `read_records`, at most so many at a time, since texts of all take much memory."""
    text = read_text(path) if text is None else text
    # Lines are decoded as they are read: a text stream in memory takes four bytes a character.
    reader = csv.reader(io.TextIOWrapper(io.BytesIO(text.encode()), encoding="utf-8", newline=""), strict=True)
    header: list[str] = []
    header_row, known = 1, dict[str, str]()
    texts: list[list[str]] = []
    lines: list[int] = []

    def block() -> Records:
        return Records(path, header, header_row, texts, np.array(lines, dtype=np.int64))

    try:
        for record in reader:
            if not (len(record) > 1 or (record and record[0].strip())):
                continue
            if not header:
                header, header_row = record, reader.line_num
                if len(header) == 1 and re.search("[;\t]", header[0]):
                    raise located(path, "expected fields separated by commas", row=header_row)
                continue
            # Nothing can be cut off from a 0 or a 1; any other last field may be a part of what was written.
            if not lines and header[-1] != "signed":
                require_line_end(path, text)
            text = ""
            if len(texts) == most:
                yield block()
                texts, lines = [], []
            # Most short fields of many rows repeat: each is held once.
            texts.append([known.setdefault(field, field) if len(field) < _SHORT else field for field in record])
            lines.append(reader.line_num)
    except csv.Error as error:
        raise located(path, f"not a line of CSV ({error})", row=max(reader.line_num, 1)) from error
    if expected and not header:
        raise InputError(f"{path}: the file holds no text, expected {expected}")
    yield block()


def read_numbers(path: Path, names: tuple[str, ...]) -> Floats:
    """The columns of a CSV file of finite numbers, shape (n_columns, n), read in one call unless something is wrong."""
    text = read_text(path)
    head, _, body = text.lstrip("\r\n").partition("\n")
    if tuple(head.strip().split(",")) != names:
        raise located(path, f"expected the header {','.join(names)}, found {shown(head.strip())}", row=1)
    if not body.strip():
        raise InputError(f"{path}: no samples under the header")
    if body.count("\n") > MAX_SAMPLES:
        raise InputError(f"{path}: more than {MAX_SAMPLES} samples")
    if body[0] in " \t" or "\n " in body or "\n\t" in body:
        # Lines of blanks are let through, as empty ones are.
        body = "\n".join(line for line in body.split("\n") if line.strip())
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=",", comments=None, ndmin=2)
    except ValueError:
        table = np.full((1, 1), np.nan)
    if table.shape[1] != len(names) or not np.isfinite(table).all():
        records = read_records(path, text=text)
        for name, fields in records.columns().items():
            records.numbers(name, [field.strip() for field in fields], finite=True)
        raise InputError(f"{path}: expected lines of {len(names)} numbers")
    require_line_end(path, text)
    return np.ascontiguousarray(table.T)


def write_table(path: Path, table: Mapping[str, NDArray[Any]]) -> None:
    """Write columns of numbers, whole numbers or texts, each of shape (n,), whole or not at all; NaN as nothing."""
    write_text(path, table_text(table))


def table_text(table: Mapping[str, NDArray[Any]]) -> str:
    """Columns of numbers, whole numbers or texts, each of shape (n,), as CSV; NaN as nothing."""
    columns = [formatted(values) if values.dtype.kind == "f" else values.tolist() for values in table.values()]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue()


def write_numbers(path: Path, names: tuple[str, ...], columns: Iterable[Floats]) -> None:
    """Write columns of numbers such that the same numbers are read back, whole or not at all."""
    # repr gives the shortest text that reads back as the same number; adding zero turns -0 into 0.
    texts = [map(repr, (column + 0.0).tolist()) for column in columns]
    write_text(path, "\n".join([",".join(names), *map(",".join, zip(*texts, strict=True)), ""]))


def formatted(values: Floats) -> list[str]:
    """Numbers as they stand in a file, NaN as nothing."""
    # Adding zero turns -0 into 0.
    return ["" if value != value else f"{value:.{_DIGITS}g}" for value in (values + 0.0).tolist()]
