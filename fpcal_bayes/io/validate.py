"""Values of nested tables (TOML, JSON) held to what a file may say, with messages that name the file and the key."""

import math
import tomllib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from fpcal_bayes.core.errors import InputError, largest
from fpcal_bayes.core.files import read_text, require_line_end


def read_toml[T](path: Path, make: Callable[[dict[str, Any]], T]) -> T:
    """What is made of the tables of a TOML file, which must not be cut short."""
    text = read_text(path)
    try:
        table = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{path}: not a TOML file: its tables are nested too deeply") from error
    except ValueError as error:
        # Beside TOMLDecodeError: an integer of more digits than Python converts.
        raise InputError(f"{path}: not a TOML file: {error}") from error
    made = make(table)
    if text[-1:].isdigit():
        require_line_end(path, text)
    return made


def shown(value: object) -> str:
    """A value as it stands in a message: quoted and no longer than a line."""
    text = str(value)
    return repr(text if len(text) <= 40 else text[:40] + "...")


def literal(value: object) -> str:
    """A value as a program writes it, and short; also for an integer of more digits than Python prints."""
    try:
        text = repr(value)
    except ValueError:
        return "a number out of range"
    return text if len(text) <= 60 else f"{text[:57]}..."


def is_number(value: object) -> bool:
    """Whether a value is a finite number."""
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(float(value))
    except OverflowError:
        return False


class Tables:
    """Reads the tables of one file; every refusal names the file and the key, and shows a value as `shown` does."""

    def __init__(self, file: object, shown: Callable[[object], str] = literal) -> None:
        self.file, self.shown = file, shown

    def error(self, key: str, expected: str) -> InputError:
        """The refusal of a key."""
        return InputError(f"{self.file}: key {key}: {expected}")

    def keys(
        self,
        table: dict[str, Any],
        place: str,
        known: Collection[str],
        *,
        named: Collection[str] = (),
        unknown: str = "unknown key",
    ) -> None:
        """Refuse keys that are not `known`; the message lists those that are, or those `named`."""
        for key in table:
            if key not in known:
                raise self.error(_at(place, key), f"{unknown}, expected one of {', '.join(sorted(named or known))}")

    def table(self, parent: dict[str, Any], place: str, key: str, expected: str = "expected a table") -> dict[str, Any]:
        """A table in a table."""
        value = parent.get(key)
        if not isinstance(value, dict):
            raise self.error(_at(place, key), expected)
        return value

    def text(self, table: dict[str, Any], place: str, key: str) -> str:
        """A line of text."""
        value = table.get(key)
        if not isinstance(value, str) or not 0 < len(value.strip()) <= 1000 or not value.isprintable():
            raise self.error(_at(place, key), "expected a line of text in quotes")
        return value

    def choice[T: str](
        self, table: dict[str, Any], place: str, key: str, choices: tuple[T, ...], default: T | None
    ) -> T:
        """One of some words."""
        value = table.get(key, default)
        for choice in choices:
            if value == choice:
                return choice
        raise self.error(_at(place, key), f"expected one of {', '.join(choices)}, found {self.shown(value)}")

    def number(
        self,
        table: dict[str, Any],
        place: str,
        key: str,
        *,
        low: float = -math.inf,
        high: float = math.inf,
        default: float | None = None,
    ) -> float:
        """A finite number from `low` to `high`, by default as large as its unit allows."""
        value = table.get(key, default)
        if value is None or not is_number(value):
            raise self.error(_at(place, key), f"expected a finite number, found {self.shown(value)}")
        low, high = max(low, -largest(key)), min(high, largest(key))
        if not low <= value <= high:
            raise self.error(_at(place, key), f"expected a number from {low:g} to {high:g}, found {self.shown(value)}")
        return float(value)

    def numbers(
        self, table: dict[str, Any], place: str, key: str, n: int, expected: str = "", *, most: float = math.inf
    ) -> list[float]:
        """A list of `n` finite numbers, of size `most` at most."""
        values = table.get(key)
        if not isinstance(values, list) or len(values) != n:
            raise self.error(_at(place, key), expected or f"expected {n} numbers")
        named = {str(i): value for i, value in enumerate(values)}
        return [self.number(named, _at(place, key), i, low=-most, high=most) for i in named]

    def flag(self, table: dict[str, Any], place: str, key: str, default: bool = False) -> bool:
        """True or false."""
        value = table.get(key, default)
        if not isinstance(value, bool):
            raise self.error(_at(place, key), f"expected true or false, found {self.shown(value)}")
        return value

    def whole(self, table: dict[str, Any], place: str, key: str, low: int, high: int, default: int) -> int:
        """A whole number from `low` to `high`."""
        value = table.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            what = f"expected a whole number from {low} to {high}, found {self.shown(value)}"
            raise self.error(_at(place, key), what)
        return value

    def optional(self, parent: dict[str, Any], place: str, key: str) -> dict[str, Any]:
        """A table in a table, empty where there is none."""
        return self.table(parent, place, key) if key in parent else {}

    def tables(self, table: dict[str, Any], key: str, expected: str) -> list[dict[str, Any]]:
        """A list of tables, which may be missing."""
        found = table.get(key, [])
        if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
            raise self.error(key, expected)
        return found


def _at(place: str, key: str) -> str:
    return f"{place}.{key}" if place else key
