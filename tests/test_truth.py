"""The truth of a simulated cell: the paper's and a user's."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import paper_tables
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.truth import read_truth
from fpcal_bayes.measure.truth import Truth, TruthRecord, paper_truth
from fpcal_bayes.model.parameters import ParameterSet

CELL = load_cell(mechanics="none")
CASE_A = json.loads((Path(__file__).parent / "data" / "case_a.json").read_text())


def shown(truth: Truth, time_h: float) -> dict[str, float]:
    return dict(zip(truth.parameters.names, truth.parameters.to_shown(truth.at(time_h)).tolist(), strict=True))


def write(folder: Path, text: str) -> Path:
    path = folder / "truth.toml"
    path.write_text(text)
    return path


def test_day_zero_is_the_truth_of_the_reference_case():
    assert shown(paper_truth(CELL), 0.0) == pytest.approx(CASE_A["truth"], abs=1e-12)


def test_full_identifications_are_epochs_and_day_seven_is_not():
    truth = paper_truth(CELL)
    assert truth.times_h.tolist() == [0.0, 24.0, 48.0, 192.0]
    assert truth.parameters.names == CELL.free.names
    last = shown(truth, 192.0)
    # Tables IV and VII, and Table II for what they leave as it was.
    for name, value in {"beta_4": -0.42, "alpha_5": -89.38, "alpha_6": -90.57, "z_et": 2.3, "z_wf": 112.2}.items():
        assert last[name] == pytest.approx(value, abs=1e-12)
    assert shown(truth, 48.0)["beta_4"] == pytest.approx(-0.30, abs=1e-12)


def test_values_between_and_outside_epochs():
    truth = paper_truth(CELL)
    assert shown(truth, 36.0)["z_et"] == pytest.approx((1.42 + 1.52) / 2)
    assert shown(truth, -5.0) == shown(truth, 0.0)
    assert shown(truth, 1e6) == shown(truth, 192.0)
    np.testing.assert_array_equal(truth.at([0.0, 36.0])[1], truth.at(36.0))


def test_tables_for_display():
    tables = paper_tables()
    assert [entry["day"] for entry in tables["identification"]] == [0, 1, 2, 7, 8]
    assert tables["setup"]["wavelength_nm"] == CELL.wavelength * 1e3
    # Table I is what the built-in cell holds.
    for stem in ("beta", "alpha", "d", "theta", "r"):
        nominal = [CELL.parameters[f"{stem}_{i}"].shown(CELL.parameters[f"{stem}_{i}"].nominal) for i in range(1, 7)]
        np.testing.assert_allclose(tables["nominal"][stem], nominal, atol=1e-12)


def test_a_cell_without_a_parameter_of_the_paper_is_refused():
    fewer = replace(CELL, parameters=ParameterSet(p for p in CELL.parameters if p.name != "theta_6"))
    with pytest.raises(InputError, match="has no parameter theta_6"):
        paper_truth(fewer)


def test_reads_parameters(tmp_path):
    truth = read_truth(write(tmp_path, "[parameters]\nalpha_4 = 0.5\nz_et = 3\ngain_4 = 120\n"), CELL)
    values = shown(truth, 77.0)
    assert set(values) == {*CELL.free.names, "gain_4"}
    nominal = dict(zip(CELL.free.names, CELL.free.to_shown(CELL.free.nominal), strict=True))
    assert values == pytest.approx(nominal | {"alpha_4": 0.5, "z_et": 3.0, "gain_4": 120.0})
    assert truth.at(0.0)[truth.parameters.position("gain_4")] == pytest.approx(120e-6)


def test_reads_epochs(tmp_path):
    text = "[[epoch]]\ntime_h = 2\n[epoch.parameters]\n[[epoch]]\ntime_h = 4.0\n[epoch.parameters]\nz_et = 8.0\n"
    truth = read_truth(write(tmp_path, text), CELL)
    assert [shown(truth, time)["z_et"] for time in (0.0, 2.0, 3.0, 4.0, 9.0)] == [0.0, 0.0, 4.0, 8.0, 8.0]


EPOCH = "[[epoch]]\ntime_h = 2.0\n[epoch.parameters]\nz_et = 1.0\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x = 1", "key x: unknown, expected one of epoch, parameters"),
        ("title = 'a'\n[parameters]", "key title: unknown"),
        ("# nothing", "key parameters: expected either"),
        (EPOCH + "[parameters]\n", "key parameters: expected either"),
        ("parameters = 3", "key parameters: expected a table"),
        ("[parameters]\nzet = 1.0", "key parameters.zet: unknown, expected one of alpha_2"),
        ("[parameters]\nz_et = 'a'", "key parameters.z_et: expected a finite number, found 'a'"),
        ("[parameters]\nz_et = true", "key parameters.z_et: expected a finite number"),
        ("[parameters]\nz_et = nan", "key parameters.z_et: expected a finite number"),
        ("[parameters]\nz_et = -inf", "key parameters.z_et: expected a finite number"),
        ("[parameters]\nz_et = [1.0]", "key parameters.z_et: expected a finite number"),
        ("[parameters]\nz_et = 1" + "0" * 400, "key parameters.z_et: expected a finite number"),
        ("[parameters]\nz_et = 1" + "0" * 5000, "not a TOML file"),
        ("[parameters\n", "not a TOML file"),
        ("epoch = 3", "key epoch: expected one or more"),
        ("epoch = []", "key epoch: expected one or more"),
        ("epoch = [3]", "key epoch 1: expected a table"),
        ("[[epoch]]\ntime_h = 1\n", "key epoch 1.parameters: expected a table"),
        ("[[epoch]]\n[epoch.parameters]\n", "key epoch 1.time_h: expected a finite number"),
        (EPOCH + EPOCH, "key epoch 2.time_h: expected more than 2 h, found 2"),
        (EPOCH + EPOCH.replace("2.0", "1.0"), "key epoch 2.time_h: expected more than 2 h, found 1"),
        (EPOCH.replace("z_et = 1.0", "z_et = nan"), "key epoch 1.parameters.z_et: expected a finite number"),
        (EPOCH.replace("time_h", "time"), "key epoch 1.time: unknown, expected one of parameters, time_h"),
        ("x = " + "[" * 5000, "nested too deeply"),
    ],
)
def test_refuses(tmp_path, text, expected):
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_truth(path, CELL)
    assert str(caught.value).startswith(f"{path}: ")
    assert expected in str(caught.value)


def test_refuses_what_is_no_file(tmp_path):
    for path, expected in ((tmp_path, "is a folder"), (tmp_path / "absent.toml", "no such file")):
        with pytest.raises(InputError, match=expected):
            read_truth(path, CELL)


def test_a_record_gives_the_truth_back():
    truth = paper_truth(CELL)
    back = Truth.of_record(truth.record(), CELL)
    assert back.parameters.names == truth.parameters.names
    np.testing.assert_allclose(back.values, truth.values, rtol=1e-14)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"names": ("z_et", "z_et")}, "stands twice"),
        ({"names": ("z_et", "zet")}, "unknown parameter 'zet'"),
        ({"units": ("um", "um")}, "parameter beta_4: expected the unit deg, found 'um'"),
        ({"units": ("um",)}, "as many units"),
        ({"values": np.zeros((2, 3))}, "values of shape"),
        ({"values": np.array([[0.0, np.nan], [0.0, 0.0]])}, "finite"),
        ({"times_h": np.array([1.0, 1.0])}, "in the order of time_h"),
    ],
)
def test_a_record_of_something_else_is_refused(change, expected):
    record = TruthRecord(("z_et", "beta_4"), ("um", "deg"), np.array([0.0, 1.0]), np.zeros((2, 2)))
    record.check(CELL, "truth")
    with pytest.raises(InputError) as caught:
        replace(record, **change).check(CELL, "truth")
    assert expected in str(caught.value)
