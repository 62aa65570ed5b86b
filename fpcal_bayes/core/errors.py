"""The one exception that bad input raises."""

#: Largest size of a number by the unit that its name ends in: wide enough for a robot of metres and for a century.
_LARGEST = {"um": 1e7, "nm": 1e10, "deg": 1e4, "ppm": 1e6, "h": 1e6, "hours": 1e6, "c": 1e3, "hpa": 1e4}
#: Of a number in another unit: its square and its cube are still numbers.
_LARGEST_OTHER = 1e12


def largest(name: str) -> float:
    """The largest size that a number called `name` can plausibly have; the unit stands at the name's end."""
    return _LARGEST.get(name.rpartition("_")[2], _LARGEST_OTHER)


class InputError(ValueError):
    """Input that cannot be used; one line for the user: file, row and column where known, and what was expected."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class UnreachableError(InputError):
    """A pose that the cell cannot take by this estimate."""


class HeldError(InputError):
    """A file that another program holds: it may be used later."""


def reason(error: BaseException) -> str:
    """Why something failed, as one line: what the system says of it, else the kind of the error and its words."""
    if isinstance(error, InputError):
        return str(error)
    system = "not enough memory" if isinstance(error, MemoryError) else getattr(error, "strerror", None)
    return " ".join((system or f"{type(error).__name__}: {error}").split())[:300]


def located(file: object, expected: str, *, row: int | None = None, column: str | None = None) -> InputError:
    """Build the message ``file: row R, column C: what was expected``; the first line of a file is row 1."""
    place = [text for text in (f"row {row}" if row is not None else "", f"column {column}" if column else "") if text]
    return InputError(": ".join([str(file), *([", ".join(place)] if place else []), expected]))
