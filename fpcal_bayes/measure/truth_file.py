"""Write a truth as the TOML that `truth.read_truth` reads."""

from pathlib import Path

from fpcal_bayes.files import write_text
from fpcal_bayes.measure.truth import Truth


def write_truth(path: str | Path, truth: Truth) -> None:
    """Write a truth to a TOML file, whole or not at all: a table ``[[epoch]]`` for each of its times.

    Parameters
    ----------
    path
        Replaced if it exists.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    record = truth.record()
    lines = []
    for time_h, values in zip(record.times_h.tolist(), record.values.tolist(), strict=True):
        lines += ["[[epoch]]", f"time_h = {time_h!r}", "[epoch.parameters]"]
        pairs = zip(record.names, values, record.units, strict=True)
        lines += [f"{name} = {value!r}  # {unit}" for name, value, unit in pairs] + [""]
    write_text(Path(path), "\n".join(lines))
