"""Messages for bad input."""

import pytest

from fpcal_bayes.core.errors import InputError, located


@pytest.mark.parametrize("message", ["two\nlines", "tab\tand  spaces", "odd\u2028separators\x85here", "\r\nends\r\n"])
def test_message_is_one_line(message: str) -> None:
    assert len(str(InputError(message)).splitlines()) == 1
    assert str(InputError(message)).split() == message.split()


@pytest.mark.parametrize(
    ("row", "column", "expected"),
    [
        (None, None, "sweeps.csv: expected a number"),
        (3, None, "sweeps.csv: row 3: expected a number"),
        (None, "dl_um", "sweeps.csv: column dl_um: expected a number"),
        (3, "dl_um", "sweeps.csv: row 3, column dl_um: expected a number"),
    ],
)
def test_place(row: int | None, column: str | None, expected: str) -> None:
    assert str(located("sweeps.csv", "expected a number", row=row, column=column)) == expected


def test_input_error_is_a_value_error() -> None:
    with pytest.raises(ValueError, match=r"^x$"):
        raise InputError("x")
