"""The interferometer of a cell: defaults, keys of its TOML file, and no part in the cell's hash."""

from dataclasses import replace
from pathlib import Path

import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.tables import Interferometer

TEXT = data_file("femto-st.toml").read_text(encoding="utf-8")


def cell_of(text: str, tmp_path: Path) -> Cell:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return load_cell(path, mechanics="none")


def test_built_in_cell_states_the_defaults(femto: Cell) -> None:
    assert femto.interferometer == Interferometer(1.56)
    assert femto.interferometer.step == pytest.approx(5.0 / 65535)


def test_optics_are_no_part_of_the_hash(femto: Cell, tmp_path: Path) -> None:
    changed = cell_of(TEXT.replace("gain_v = 50.0", "gain_v = 20.0").replace('"two-beam" ', '"airy" '), tmp_path)
    assert (changed.interferometer.gain, changed.interferometer.beams) == (20.0, "airy")
    assert changed.sha256 == femto.sha256


def test_a_cell_without_optics_has_the_defaults(tmp_path: Path) -> None:
    start, end = TEXT.index("beams ="), TEXT.index("# The stage reads")
    assert cell_of(TEXT[:start] + TEXT[end:], tmp_path).interferometer == Interferometer(1.56)


def test_wavelength_is_that_of_the_cell(femto: Cell) -> None:
    assert replace(femto, wavelength=1.55).interferometer.wavelength == 1.55


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("gain_v = 50.0", "gain_v = 0", "key optics.gain_v: expected a number from 1e-09"),
        ("bits = 16", "bits = 16.5", "key optics.bits: expected a whole number from 1 to 32, found 16.5"),
        ("bits = 16", "bits = true", "key optics.bits: expected a whole number from 1 to 32, found True"),
        ('"two-beam" ', '"three" ', "key optics.beams: expected one of two-beam, airy, found 'three'"),
        ("mode_field_radius_um = 5.2", 'mode_field_radius_um = "x"', "key optics.mode_field_radius_um: expected a fin"),
        ("fibre_reflectivity = 0.033", "fibre_reflectivity = 1.2", "key optics.fibre_reflectivity: expected a number"),
        ("noise_v = 0.01", "noise_mv = 10", "key optics.noise_mv: unknown key"),
    ],
)
def test_bad_keys_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(InputError, match=message):
        cell_of(TEXT.replace(old, new, 1), tmp_path)
