"""A file that ends in the middle of its last value is refused: "12.5" cut to "1" is a number too."""

import errno
import gc
from pathlib import Path

import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_line_end
from fpcal_bayes.infer.posterior.netcdf import write_netcdf
from fpcal_bayes.io.campaign import write_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.joint_paths import read_path
from fpcal_bayes.io.sweeps import read_csv, write_csv
from fpcal_bayes.io.traces import read_scan
from fpcal_bayes.io.truth import read_truth
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
PATH = "x_um,y_um,z_um,rx_deg,ry_deg,rz_deg\n0,0,0,0,0,0\n20,0,10,0,0,12.5\n"
SCAN = "wavelength_nm,irradiance_v\n1540,0.11\n1541,0.12\n1542,0.13\n1543,0.145\n"
TRUTH = "[parameters]\nalpha_2 = -90.1\nz_et = 12.55\n"


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("path.csv", PATH, read_path),
        ("scan.csv", SCAN, read_scan),
        ("truth.toml", TRUTH, lambda p: read_truth(p, CELL)),
    ],
)
def test_a_number_cut_short_is_refused(tmp_path, name, text, read):
    path = tmp_path / name
    path.write_text(text)
    read(path)
    for cut in (1, 2):
        path.write_text(text[:-cut])
        with pytest.raises(InputError, match=r"row \d+: expected a line end after the last row") as refused:
            read(path)
        assert str(refused.value).startswith(str(path))


def test_sweeps_cut_in_a_group_s_name_are_refused(tmp_path):
    path = tmp_path / "sweeps.csv"
    write_csv(path, paper_protocol(CELL, midpoints=True), CELL)
    text = path.read_text()
    path.write_text(text[:-3])
    with pytest.raises(InputError, match=r"row 139: expected a line end after the last row"):
        read_csv(path, CELL, plan=True)


def test_what_cannot_be_cut_short_needs_no_line_end(tmp_path):
    path = tmp_path / "sweeps.csv"
    write_csv(path, simulate_um(CELL, paper_truth(CELL), paper_protocol(CELL), sigma=0.005, seed=0), CELL)
    text = path.read_text()
    assert text.splitlines()[0].endswith(",signed")
    path.write_text(text[:-1])
    assert len(read_csv(path, CELL)) == 69
    truth = tmp_path / "truth.toml"
    truth.write_text("[parameters]\nalpha_2 = -90.1  # as measured")
    read_truth(truth, CELL)
    require_line_end(truth, "")
    require_line_end(truth, "a\r\n")


class TestFullDisk:
    """HDF5 files are made in memory: a full disk is met by plain writing, which can be refused in one line."""

    @pytest.fixture(autouse=True)
    def full_disk(self, monkeypatch):
        def no_space(path, content):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(Path, "write_bytes", no_space)

    def test_campaign(self, tmp_path):
        plan = paper_protocol(CELL)
        with pytest.raises(InputError, match=r"a\.h5: cannot be written \(No space left on device\)"):
            write_campaign(tmp_path / "a.h5", Campaign.of(plan, CELL), CELL)
        assert not list(tmp_path.iterdir())

    def test_posterior(self, tmp_path):
        xarray = pytest.importorskip("xarray")
        tree = xarray.DataTree.from_dict({"posterior": xarray.Dataset({"a": (("chain", "draw"), [[1.0, 2.0]])})})
        with pytest.raises(InputError, match=r"a\.nc: cannot be written \(No space left on device\)"):
            write_netcdf(tree, tmp_path / "a.nc")
        assert not list(tmp_path.iterdir())
        # A buffer that the error's frame kept ended Python here.
        gc.collect()
