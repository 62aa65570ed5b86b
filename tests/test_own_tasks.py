"""Tasks that a cell states for itself."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.motion.tasks import find_task

FEMTO = data_file("femto-st.toml").read_text()
TABLES = """
[[task]]
name = "small"
kind = "circle"
radius_um = 20.0
centre_um = [30.0, 0.0, -10.0]
tolerance = { beam_nm = 5.0, rx_deg = 0.01 }
[[task]]
name = "in and out"
kind = "line-y"
range_um = [-5.0, 15.0]
[[task]]
name = "nod"
kind = "tilt-x"
range_deg = [0.0, 2.0]
"""


def test_tasks_of_ones_own(femto, tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(FEMTO + TABLES)
    cell = load_cell(path, mechanics="none")
    # They change no length: estimates stay valid.
    assert cell.sha256 == femto.sha256
    assert cell.tasks[0].tolerances == pytest.approx({"beam": 0.005, "rx": np.radians(0.01)})
    vector = cell.parameters.nominal
    circle = find_task(cell, vector, "small", n_points=5)
    # q3 along Xf, q1 along Zf.
    assert_allclose(circle.q[:, [2, 0]], [[50, -10], [30, 10], [10, -10], [30, -30], [50, -10]], atol=1e-9)
    line = find_task(cell, vector, "in and out", n_points=3)
    assert (line.unit, line.along.tolist()) == ("um", [-5.0, 5.0, 15.0])
    assert_allclose(np.abs(line.q[:, 1]), [5.0, 5.0, 15.0], atol=1e-9)
    nod = find_task(cell, vector, "nod", n_points=3)
    assert nod.unit == "deg"
    assert_allclose(np.degrees(np.abs(nod.q[:, 3])), [0.0, 1.0, 2.0], atol=1e-9)
    with pytest.raises(InputError, match=r"task .other.: expected .* small, in and out, nod"):
        find_task(cell, vector, "other")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('kind = "circle"', 'kind = "square"', "key task 1.kind: expected one of line-x"),
        ('name = "small"', 'name = "circle"', "key task 1.name: 'circle' is taken"),
        ('name = "nod"', 'name = "small"', "key task 3.name: 'small' is taken"),
        ('name = "nod"', "name = 3", "key task 3.name: expected a line of text"),
        ("radius_um = 20.0", "radius_um = 0", "key task 1.radius_um: expected a number"),
        ("radius_um = 20.0", "range_um = [0, 1]", "key task 1.range_um: unknown key"),
        ("[-5.0, 15.0]", "[15.0, -5.0]", "key task 2.range_um: expected low < high"),
        ("[-5.0, 15.0]", "[15.0]", "key task 2.range_um: expected 2 numbers"),
        ("[0.0, 2.0]", "[0.0, 270.0]", "key task 3.range_deg: expected angles"),
        ("[30.0, 0.0, -10.0]", '[30.0, "a", 0]', "key task 1.centre_um.1: expected a finite number"),
        ("{ beam_nm = 5.0, rx_deg = 0.01 }", "5", "key task 1.tolerance: expected a table"),
        ("beam_nm", "beam_um", "key task 1.tolerance.beam_um: unknown key"),
        ("[[task]]", "[task]", "not a TOML file"),
    ],
)
def test_tables_that_are_none(old, new, expected, tmp_path):
    assert old in TABLES
    path = tmp_path / "cell.toml"
    path.write_text(FEMTO + TABLES.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_cell(path, mechanics="none")
    assert str(caught.value).startswith(f"{path}: {expected}")
