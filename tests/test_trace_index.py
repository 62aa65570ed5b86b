"""Indices of recorded sweeps: round trips in every format, and every refusal."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat
from trace_fixtures import record_all, scan

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.recordings import read_recordings, write_recordings
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.traces import Trace
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell


@pytest.fixture(scope="module")
def index(femto: Cell) -> TraceIndex:
    """Three sweeps, of a joint in deg and of two in um; the second has scans and air."""
    truth = paper_truth(femto)
    sweeps = paper_protocol(femto).take(np.array([0, 45, 46]))
    made = record_all(femto, CavityModel.of(femto, truth.parameters), truth.at(0.0), sweeps, 1, 5.0)
    random = np.random.default_rng(3)
    return replace(
        made,
        wavelength=np.array([np.nan, 1.55, np.nan]),
        temperature_c=np.array([np.nan, 20.5, np.nan]),
        pressure_hpa=np.array([np.nan, 1013.0, np.nan]),
        humidity_pct=np.array([np.nan, 40.0, np.nan]),
        scans_before=[None, scan(random, 920.0, 60), None],
        scans_after=[None, scan(random, 921.0, 60), scan(random, 900.0, 60)],
    )


def same(one: TraceIndex, other: TraceIndex) -> None:
    np.testing.assert_array_equal(one.sweeps.label, other.sweeps.label)
    np.testing.assert_allclose(one.sweeps.q_start, other.sweeps.q_start, atol=1e-13)
    np.testing.assert_allclose(one.sweeps.q_end, other.sweeps.q_end, atol=1e-13)
    for name in ("wavelength", "temperature_c", "pressure_hpa", "humidity_pct"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12)
    for a, b in zip(one.traces, other.traces, strict=True):
        np.testing.assert_array_equal(a.time_s, b.time_s)
        np.testing.assert_allclose(a.joint, b.joint, rtol=3e-16)
        np.testing.assert_array_equal(a.irradiance, b.irradiance)
    for name in ("scans_before", "scans_after"):
        for a, b in zip(getattr(one, name), getattr(other, name), strict=True):
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_allclose(a.wavelength, b.wavelength, rtol=3e-16)
                np.testing.assert_array_equal(a.irradiance, b.irradiance)


@pytest.mark.parametrize("name", ["index.csv", "index.h5"])
def test_an_index_reads_back(tmp_path: Path, femto: Cell, index: TraceIndex, name: str) -> None:
    write_recordings(tmp_path / name, index, femto)
    same(read_recordings(tmp_path / name, femto), index)


def test_equal_indices_give_equal_bytes(tmp_path: Path, femto: Cell, index: TraceIndex) -> None:
    for name in ("a.h5", "b.h5"):
        write_recordings(tmp_path / name, index, femto)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_an_unknown_suffix_is_refused(tmp_path: Path, femto: Cell, index: TraceIndex) -> None:
    with pytest.raises(InputError, match=r"expected a file name that ends in \.csv"):
        write_recordings(tmp_path / "index.txt", index, femto)


def cells(values: list[Any]) -> np.ndarray:
    array = np.empty((len(values), 1), dtype=object)
    array[:, 0] = values
    return array


def variables(femto: Cell, index: TraceIndex) -> dict[str, Any]:
    """What a MATLAB user would save."""
    sweeps, scales = index.sweeps, femto.joint_scales
    content: dict[str, Any] = {"label": cells(sweeps.label.tolist()), "time_h": sweeps.time_h[:, None]}
    for end, q in (("start", sweeps.q_start), ("end", sweeps.q_end)):
        for column, values in zip(femto.joint_columns, (q / scales).T, strict=True):
            joint, unit = column.split("_")
            content[f"{joint}_{end}_{unit}"] = values[:, None]
    moved = [int(np.argmax(a != b)) for a, b in zip(sweeps.q_start, sweeps.q_end, strict=True)]
    content["t_s"] = cells([trace.time_s[:, None] for trace in index.traces])
    content["joint"] = cells([t.joint[:, None] / scales[j] for t, j in zip(index.traces, moved, strict=True)])
    content["irradiance_v"] = cells([trace.irradiance[:, None] for trace in index.traces])
    return content


def save_hdf5(path: Path, content: dict[str, Any]) -> None:
    """As MATLAB writes version 7.3: arrays transposed, texts as codes, cells as references."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name: str, value: Any) -> h5py.Dataset:
            array = np.asarray(value)
            kind = {"O": "cell", "U": "char"}.get(array.dtype.kind, "double")
            if kind == "cell":
                data = np.empty(array.T.shape, dtype=h5py.ref_dtype)
                for at in np.ndindex(*array.shape):
                    data[at[::-1]] = put(f"#refs#/{name}{at[0]}", array[at]).ref
            elif kind == "char":
                data = np.array([[ord(letter)] for letter in str(value)], dtype=np.uint16)
            else:
                data = np.atleast_2d(array).T if array.size else np.array([0, 0], dtype=np.uint64)
            made = file.create_dataset(name, data=data)
            made.attrs["MATLAB_class"] = np.bytes_(kind)
            if not array.size:
                made.attrs["MATLAB_empty"] = np.uint8(1)
            return made

        for name, value in content.items():
            put(name, value)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("save", [savemat, save_hdf5])
def test_a_matlab_file_is_read(tmp_path: Path, femto: Cell, index: TraceIndex, save: Any) -> None:
    content = variables(femto, index)
    content["temperature_c"] = index.temperature_c[:, None]
    content["scan_after_wavelength_nm"] = cells([[] if s is None else s.wavelength * 1e3 for s in index.scans_after])
    content["scan_after_irradiance_v"] = cells([[] if s is None else s.irradiance for s in index.scans_after])
    save(tmp_path / "index.mat", content)
    back = read_recordings(tmp_path / "index.mat", femto)
    for one, other in zip(back.traces, index.traces, strict=True):
        np.testing.assert_allclose(one.joint, other.joint, rtol=1e-15)
        np.testing.assert_array_equal(one.irradiance, other.irradiance)
    assert back.scans_before == [None] * 3
    assert back.scans_after[0] is None
    assert back.scans_after[1] is not None
    assert len(back.scans_after[1]) == 60
    assert back.temperature_c[1] == 20.5


def test_a_matlab_file_of_beams_that_the_cell_does_not_have_is_refused(
    tmp_path: Path, femto: Cell, index: TraceIndex
) -> None:
    savemat(tmp_path / "index.mat", variables(femto, index) | {"beam": np.array(["a", "a", "a"], dtype=object)})
    with pytest.raises(InputError, match="column beam: cell 'femto-st' names no beam"):
        read_recordings(tmp_path / "index.mat", femto)


@pytest.mark.parametrize("missing", ["t_s", "irradiance_v", "q4_end_deg"])
def test_a_matlab_file_without_a_variable_is_refused(
    tmp_path: Path, femto: Cell, index: TraceIndex, missing: str
) -> None:
    content = variables(femto, index)
    del content[missing]
    savemat(tmp_path / "index.mat", content)
    with pytest.raises(InputError, match=f"the variable {missing} is missing"):
        read_recordings(tmp_path / "index.mat", femto)


def test_matlab_files_that_cannot_be_read_are_refused(tmp_path: Path, femto: Cell, index: TraceIndex) -> None:
    (tmp_path / "no.mat").write_bytes(b"not a MATLAB file" * 40)
    with pytest.raises(InputError, match="not a MATLAB file"):
        read_recordings(tmp_path / "no.mat", femto)
    with h5py.File(tmp_path / "new.mat", "w"):
        pass
    with pytest.raises(InputError, match=r"the variable q1_start_um is missing"):
        read_recordings(tmp_path / "new.mat", femto)
    content = variables(femto, index)
    content["joint"] = np.zeros((3, 5))
    savemat(tmp_path / "flat.mat", content)
    with pytest.raises(InputError, match="variable joint: expected a cell array of 3 vectors"):
        read_recordings(tmp_path / "flat.mat", femto)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("index_traces/1.csv", "index_traces/9.csv", "row 2, column trace: 'index_traces/9.csv': no such file"),
        ("index_traces/1.csv", "../secret.csv", "row 2, column trace: '../secret.csv': expected a path inside"),
        ("index_traces/1.csv", "/etc/passwd", "row 2, column trace: '/etc/passwd': expected a path inside"),
        ("index_traces/1.csv", "C:\\\\traces\\\\1.csv", "expected a path inside"),
        ("index_traces/1.csv", "", "expected the file of a trace, found none"),
        (",trace", ",tracks", "unknown column 'tracks'"),
        ("trace,wavelength_nm", "trace,dl_um", "these are sweeps, not traces"),
        (",1550,", ",-1550,", "row 3, column wavelength_nm: expected a wavelength in nm, 200 to 20000"),
        (",1013,", ",lots,", "row 3, column pressure_hpa: expected a number, found 'lots'"),
        (",40,", ",140,", "row 3, column humidity_pct: expected 0 to 100"),
    ],
)
def test_a_faulty_index_is_refused(
    tmp_path: Path, femto: Cell, index: TraceIndex, old: str, new: str, message: str
) -> None:
    write_recordings(tmp_path / "index.csv", index, femto)
    (tmp_path.parent / "secret.csv").write_text("t_s,joint,irradiance_v\n0,0,0\n1,1,1\n")
    edit(tmp_path / "index.csv", old, new)
    with pytest.raises(InputError) as caught:
        read_recordings(tmp_path / "index.csv", femto)
    assert message.lower() in str(caught.value).lower() or (new == ",tracks" and "trace" in str(caught.value))
    assert "\n" not in str(caught.value)


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path, femto: Cell, index: TraceIndex) -> None:
    folder = tmp_path / "inner"
    folder.mkdir()
    write_recordings(folder / "index.csv", index, femto)
    outside = tmp_path / "outside.csv"
    (folder / "index_traces" / "1.csv").rename(outside)
    (folder / "index_traces" / "1.csv").symlink_to(outside)
    with pytest.raises(InputError, match="expected a path inside the folder of the index"):
        read_recordings(folder / "index.csv", femto)


def test_an_absolute_length_needs_a_scan(femto: Cell, index: TraceIndex, tmp_path: Path) -> None:
    sweeps = replace(index.sweeps, kind=np.array(["absolute", "sweep", "absolute"]))
    empty = Trace(np.zeros(0), np.zeros(0), np.zeros(0))
    lengths = replace(index, sweeps=sweeps, traces=[empty, index.traces[1], empty])
    with pytest.raises(InputError, match="row 2, column scan_after: 'node0-rx': an absolute length needs a scan"):
        write_recordings(tmp_path / "index.csv", lengths, femto)
    good = replace(lengths, scans_after=[index.scans_after[2], None, index.scans_after[2]])
    for name in ("index.csv", "index.h5"):
        write_recordings(tmp_path / name, good, femto)
        same(read_recordings(tmp_path / name, femto), good)


def test_damaged_hdf5_is_refused(tmp_path: Path, femto: Cell, index: TraceIndex) -> None:
    write_recordings(tmp_path / "index.h5", index, femto)
    with h5py.File(tmp_path / "index.h5", "r+") as file:
        file["traces/trace_end"][1] = 5
        file["traces/trace_end"][0] = 6
    with pytest.raises(InputError, match="trace_end: expected whole numbers that rise"):
        read_recordings(tmp_path / "index.h5", femto)
