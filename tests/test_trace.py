"""Traces and scans in CSV files: round trip, and every refusal."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.traces import read_scan, read_trace, unscaled, write_scan, write_trace
from fpcal_bayes.measure.traces import Trace, WavelengthScan

HEADER = "t_s,joint,irradiance_v\n"


def test_a_trace_reads_back_the_same_floats(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    for scale in (1.0, np.pi / 180.0):
        trace = Trace(np.cumsum(random.uniform(size=200)), scale * random.normal(size=200), random.normal(size=200))
        write_trace(tmp_path / "t.csv", trace, scale)
        back = read_trace(tmp_path / "t.csv", scale)
        np.testing.assert_array_equal(back.time_s, trace.time_s)
        np.testing.assert_array_equal(back.joint, trace.joint)
        np.testing.assert_array_equal(back.irradiance, trace.irradiance)
        assert back.file == str(tmp_path / "t.csv")


def test_a_scan_reads_back(tmp_path: Path) -> None:
    scan = WavelengthScan(np.linspace(1.6, 1.52, 50), np.random.default_rng(2).normal(size=50))
    write_scan(tmp_path / "s.csv", scan)
    back = read_scan(tmp_path / "s.csv")
    np.testing.assert_allclose(back.wavelength, scan.wavelength, rtol=3e-16)
    np.testing.assert_array_equal(back.irradiance, scan.irradiance)


@given(st.floats(min_value=-1e6, max_value=1e6), st.sampled_from([1.0, np.pi / 180.0]))
def test_unscaled_undoes_a_scale(shown: float, scale: float) -> None:
    value = np.array([shown * scale])
    np.testing.assert_array_equal(unscaled(value, scale) * scale, value)


def test_blank_lines_and_windows_line_ends_are_accepted(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(b"t_s,joint,irradiance_v\r\n\r\n0,1,2\r\n\r\n1,2,3\r\n")
    np.testing.assert_array_equal(read_trace(tmp_path / "t.csv", 1.0).joint, [1.0, 2.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "0,1,2\n1,nan,2\n", "row 3, column joint: expected a number, found 'nan'"),
        (HEADER + "0,1,2\n1,,2\n", "row 3, column joint: expected a number, found nothing"),
        (HEADER + "0,1,2\n\n1,x,2\n", "row 4, column joint: expected a number, found 'x'"),
        (HEADER + "0,1,2\n1,2\n", "row 3: expected 3 fields, found 2"),
        (HEADER + "0,1,2,9\n1,2\n", "row 2: expected 3 fields, found 4"),
        (HEADER + "0,1,2\n\n2,1,2\n1,1,2\n", "row 5, column t_s: expected a time later than the 2 s before it"),
        (HEADER + "0,1,2\n0,1,2\n", "row 3, column t_s: expected a time later than"),
        (HEADER + "0,1,2\n", "1 samples, expected two or more"),
        (HEADER, "no samples under the header"),
        ("t,joint,irradiance_v\n0,1,2\n", "row 1: expected the header t_s,joint,irradiance_v"),
        (HEADER + "0,1,2\n1,1,1e999\n", "expected"),
        (HEADER + "0,1,2\n1 1,1,1\n", "row 3, column t_s: expected a number, found '1 1'"),
    ],
)
def test_what_is_no_trace_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_trace(tmp_path / "t.csv", 1.0)
    assert message in str(caught.value)
    assert "t.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1550,1\n1551,1\n1550.5,1\n", "row 4, column wavelength_nm: expected wavelengths that only rise or only fall"),
        ("-1550,1\n1551,1\n", "row 2, column wavelength_nm: expected a wavelength in nm, 200 to 20000"),
        ("1550,1\n1551,inf\n", "row 3, column irradiance_v: expected a number, found 'inf'"),
    ],
)
def test_what_is_no_scan_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "s.csv").write_text("wavelength_nm,irradiance_v\n" + text)
    with pytest.raises(InputError, match=message):
        read_scan(tmp_path / "s.csv")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        read_trace(tmp_path / "none.csv", 1.0)
