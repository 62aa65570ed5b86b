"""Campaign files: round trip, layout for other programs, and every refusal."""

import hashlib
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import fpcal_bayes
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import is_campaign_file, read_csv, read_sweeps, write_csv, write_sweeps
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
CASE_A = Path(__file__).parent / "data" / "case_a.csv"


def campaign() -> Campaign:
    sweeps = simulate_um(CELL, paper_truth(CELL), paper_protocol(CELL, midpoints=True), sigma=0.005, seed=3)
    return Campaign.of(sweeps, CELL, command="fpcal simulate --seed 3", seed=3, truth=paper_truth(CELL).record())


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "campaign.h5"
    write_campaign(path, campaign(), CELL)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_campaign(path, CELL)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert len(message.splitlines()) == 1
    return message.removeprefix(str(path) + ": ")


def test_gives_back_what_was_written(written):
    wrote, read = campaign(), read_campaign(written, CELL)
    assert (read.cell_name, read.cell_sha256, read.opd) == ("femto-st", CELL.sha256, "axis")
    assert (read.command, read.seed, read.program_version) == (wrote.command, 3, fpcal_bayes.__version__)
    for name in ("session", "label", "group", "kind", "signed", "dl", "sigma", "time_h"):
        np.testing.assert_array_equal(getattr(read.sweeps, name), getattr(wrote.sweeps, name), err_msg=name)
    np.testing.assert_allclose(read.sweeps.q_end, wrote.sweeps.q_end, rtol=1e-15)
    assert read.truth is not None
    assert wrote.truth is not None
    assert (read.truth.names, read.truth.units) == (wrote.truth.names, wrote.truth.units)
    np.testing.assert_array_equal(read.truth.values, wrote.truth.values)
    np.testing.assert_array_equal(read.truth.times_h, [0.0, 24.0, 48.0, 192.0])


def test_without_truth_seed_and_estimates(tmp_path):
    path = tmp_path / "plain.hdf5"
    write_sweeps(path, read_csv(CASE_A, CELL), CELL, command="fpcal ingest")
    read = read_campaign(path, CELL)
    assert (read.seed, read.truth, read.command) == (None, None, "fpcal ingest")
    np.testing.assert_array_equal(read.sweeps.dl, read_csv(CASE_A, CELL).dl)


def test_equal_content_gives_equal_bytes(written, tmp_path):
    digest = hashlib.sha256(written.read_bytes()).hexdigest()
    # A clock in the file would show after a second.
    time.sleep(1.1)
    write_campaign(tmp_path / "again.h5", campaign(), CELL)
    assert hashlib.sha256((tmp_path / "again.h5").read_bytes()).hexdigest() == digest


def test_other_programs_can_read_it(written):
    with h5py.File(written) as root:
        assert root.attrs["schema"] == b"fpcal-campaign"
        assert root.attrs["schema_version"] == 1
        sweeps = root["sweeps"]
        assert sweeps["q4_start_deg"].attrs["unit"] == b"deg"
        assert sweeps["q1_end_um"].attrs["unit"] == sweeps["dl_um"].attrs["unit"] == b"um"
        assert sweeps["time_h"].attrs["unit"] == b"h"
        np.testing.assert_allclose(sweeps["q4_start_deg"][:2], -3.0)
        assert sweeps["label"].asstr()[1] == "node0-rx"
        assert root["truth/units"].asstr()[0] == "deg"


def test_a_plan_may_lack_a_measurement(tmp_path):
    path = tmp_path / "plan.h5"
    write_sweeps(path, paper_protocol(CELL), CELL)
    assert not read_sweeps(path, CELL, plan=True).measured
    assert "the column dl_um is missing" in refusal(path)


def test_the_other_path_model_reads_the_same_file(written):
    assert read_campaign(written, CELL.with_opd("perpendicular")).opd == "axis"


def test_another_cell_is_refused(written):
    other = replace(CELL, name="other")
    with pytest.raises(InputError) as caught:
        read_campaign(written, other)
    message = str(caught.value)
    assert f"made with cell 'femto-st' (sha256 '{CELL.sha256[:8]}')" in message
    assert f"expected cell 'other' (sha256 '{other.sha256[:8]}')" in message
    with pytest.raises(InputError, match="expected cell 'other'"):
        write_campaign(written, campaign(), other)


def test_text_of_variable_length_is_read(written):
    with h5py.File(written, "r+") as root:
        label = root["sweeps/label"].asstr()[:]
        del root["sweeps/label"]
        root["sweeps"].create_dataset("label", data=label, dtype=h5py.string_dtype())
        root.attrs["command"] = "edited"
        root.attrs["schema_version"] = np.array([1])
    read = read_campaign(written, CELL)
    assert read.command == "edited"
    assert read.sweeps.label.tolist() == campaign().sweeps.label.tolist()


def _newer(root):
    root.attrs["schema_version"] = 2


def _external_data(root):
    n = len(root["sweeps/dl_um"])
    del root["sweeps/dl_um"]
    root["sweeps"].create_dataset("dl_um", shape=(n,), dtype="f8", external=[("/etc/hostname", 0, 8 * n)])


def _virtual_data(root):
    n = len(root["sweeps/dl_um"])
    del root["sweeps/dl_um"]
    layout = h5py.VirtualLayout(shape=(n,), dtype="f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", shape=(n,))
    root["sweeps"].create_virtual_dataset("dl_um", layout)


def _set(path, value):
    def edit(root):
        del root[path]
        if value is not None:
            root[path] = value

    return edit


def _first(path, value):
    def edit(root):
        root[path][0] = value

    return edit


def _attribute(name, value):
    def edit(root):
        if value is None:
            del root.attrs[name]
        else:
            root.attrs[name] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (_newer, "written by a newer fpcal: schema 2, this program reads 1"),
        (_attribute("schema_version", 0), "expected schema_version 1, found 0"),
        (_attribute("schema_version", "one"), "attribute schema_version: expected a whole number"),
        (_attribute("schema", "other"), "expected an HDF5 file of schema fpcal-campaign, found 'other'"),
        (_attribute("schema", None), "attribute schema: missing"),
        (_attribute("schema", 3.0), "attribute schema: expected text"),
        (_attribute("cell_sha256", None), "attribute cell_sha256: missing"),
        (_attribute("seed", "three"), "attribute seed: expected a whole number"),
        (_attribute("opd", "both"), "attribute opd: expected one of axis, perpendicular, distance, found 'both'"),
        (_attribute("opd", "perpendicular"), "made with cell 'femto-st'"),
        (_set("sweeps", None), "/sweeps: the group is missing"),
        (_set("sweeps", np.zeros(3)), "/sweeps: expected a group"),
        (_set("sweeps/dl_um", None), "/sweeps: the column dl_um is missing"),
        (_set("sweeps/dl_um", np.zeros(3)), "/sweeps/dl_um: expected 138 values as in q1_start_um, found 3"),
        (_set("sweeps/dl_um", np.zeros((138, 1))), "/sweeps/dl_um: expected 1 axes, found shape (138, 1)"),
        (_set("sweeps/dl_um", 3.0), "/sweeps/dl_um: expected 1 axes, found shape ()"),
        (_set("sweeps/dl_um", h5py.Empty("f8")), "/sweeps/dl_um: expected 1 axes"),
        (_set("sweeps/dl_um", ["a"] * 138), "/sweeps/dl_um: expected numbers"),
        (_set("sweeps/dl_um", np.zeros(138, dtype=complex)), "/sweeps/dl_um: expected numbers"),
        (_set("sweeps/label", np.zeros(138)), "/sweeps/label: expected text"),
        (_set("sweeps/label", [b"\xff"] * 138), "truncated or damaged"),
        (_set("sweeps/dl_um", h5py.SoftLink("/sweeps/sigma_um")), "/sweeps/dl_um: expected a dataset, found a link"),
        (_set("sweeps", h5py.ExternalLink("elsewhere.h5", "/")), "/sweeps: expected a group, found a link"),
        (_external_data, "/sweeps/dl_um: the data lie in another file"),
        (_virtual_data, "/sweeps/dl_um: the data lie in another file"),
        (lambda root: root["sweeps"].create_dataset("note", data=[1.0]), "/sweeps: unknown column 'note'"),
        (lambda root: root["sweeps"].create_dataset("beam", data=[1.0]), "/sweeps/beam: expected text"),
        (_first("sweeps/dl_um", np.nan), "row 1, column dl_um: expected a finite number"),
        (_first("sweeps/time_h", np.inf), "row 1, column time_h: expected a finite number"),
        (_first("sweeps/sigma_um", 0.0), "row 1, column sigma_um: expected a standard deviation above zero"),
        (_first("sweeps/signed", 7), "row 1, column signed: expected 1"),
        (_first("sweeps/q4_end_deg", 6.0), "row 1, column q4_end_deg: 6 deg is outside"),
        (_first("sweeps/session", b""), "row 1, column session: expected the name"),
        (_first("sweeps/session", b"a\x1bb"), "row 1, column session: expected text without control"),
        (_set("truth/names", None), "/truth/names: the dataset is missing"),
        (
            _set("truth/values", np.zeros((4, 3))),
            "/truth: expected as many units as names, and values of shape (4, 21)",
        ),
        (_first("truth/names", b"zet"), "/truth: unknown parameter 'zet'"),
        (_first("truth/units", b"um"), "/truth: parameter alpha_2: expected the unit deg"),
        (_first("truth/time_h", 30.0), "/truth: expected epochs in the order of time_h"),
        (_first("truth/values", np.nan), "/truth: expected finite numbers"),
    ],
)
def test_refuses_what_is_not_as_documented(written, edit, expected):
    with h5py.File(written, "r+") as root:
        edit(root)
    assert expected in refusal(written)


def test_a_promise_of_terabytes_is_not_believed(written):
    with h5py.File(written, "r+") as root:
        del root["sweeps/dl_um"]
        root["sweeps"].create_dataset("dl_um", shape=(10**12,), dtype="f8", chunks=(1000,))
    assert "/sweeps/dl_um: the file holds more than 1024 MiB" in refusal(written)


def test_refuses_files_that_are_none(written, tmp_path):
    whole = written.read_bytes()
    for content, expected in [
        (b"", "the file is empty"),
        (whole[:2000], "damaged"),
        (b"session,time_h", "not an HDF5"),
    ]:
        written.write_bytes(content)
        assert expected in refusal(written)
    assert "no such file" in refusal(tmp_path / "absent.h5")
    assert "is a folder" in refusal(tmp_path)


@pytest.mark.parametrize("place", range(1000, 35000, 1700))
def test_a_damaged_byte_is_noticed_or_harmless(written, place):
    content = bytearray(written.read_bytes())
    content[place] ^= 0x20
    written.write_bytes(content)
    try:
        read = read_campaign(written, CELL)
    except InputError:
        return
    np.testing.assert_array_equal(read.sweeps.dl, campaign().sweeps.dl)
    np.testing.assert_allclose(read.sweeps.q_end, campaign().sweeps.q_end, rtol=1e-15)


def test_a_failed_write_leaves_the_old_file(written):
    before = written.read_bytes()
    bad = campaign()
    bad = replace(bad, sweeps=bad.sweeps.with_measurement(bad.sweeps.dl, -1.0))
    with pytest.raises(InputError, match="sigma_um"):
        write_campaign(written, bad, CELL)
    with pytest.raises(InputError, match="seed"):
        write_campaign(written, replace(campaign(), seed=-1), CELL)
    assert written.read_bytes() == before
    assert list(written.parent.iterdir()) == [written]


def test_the_format_follows_content_and_suffix(written, tmp_path):
    disguised = tmp_path / "sweeps.csv"
    disguised.write_bytes(written.read_bytes())
    assert is_campaign_file(disguised)
    assert len(read_sweeps(disguised, CELL)) == 138
    assert not is_campaign_file(CASE_A)
    assert len(read_sweeps(CASE_A, CELL)) == 69
    text = tmp_path / "text.H5"
    write_csv(text, read_csv(CASE_A, CELL), CELL)
    with pytest.raises(InputError, match="not an HDF5 file"):
        read_sweeps(text, CELL)
    with pytest.raises(InputError, match=r"expected a file name that ends in \.csv"):
        write_sweeps(tmp_path / "a.txt", read_csv(CASE_A, CELL), CELL)
    with pytest.raises(InputError, match="no such file"):
        read_sweeps(tmp_path / "absent", CELL)
