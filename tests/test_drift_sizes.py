"""Drift sizes in a cell's file."""

from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cell.tables import DriftSize

WHOLE = (Path(__file__).parents[1] / "data" / "femto-st.toml").read_text().split("[extrinsic.drift]")[0]
TEXT = "\n".join(line for line in WHOLE.splitlines() if not line.startswith("drift = "))


def cell_with(tmp_path, drift: str):
    path = tmp_path / "cell.toml"
    path.write_text(f"{TEXT}\n[extrinsic.drift]\n{drift}\n")
    return load_cell(path, mechanics="none")


def test_every_part_is_read_in_its_units(tmp_path):
    drift = """
    beta_wf = { walk_deg = 0.1, rate_sd_deg = 0.2, bounded_sd_deg = 0.3, bounded_hours = 5.0 }
    x_wf = { temperature_um = -0.4, temperature_sd_um = 0.1 }
    """
    deg = np.pi / 180.0
    assert cell_with(tmp_path, drift).drift == (
        DriftSize("beta_wf", 0.1 * deg, 0.2 * deg, 0.3 * deg, 5.0),
        DriftSize("x_wf", temperature=-0.4, temperature_sd=0.1),
    )


@pytest.mark.parametrize(
    ("drift", "message"),
    [
        ("r_1 = { walk_um = 1.0 }", "key extrinsic.drift.r_1: unknown key"),
        ("x_wf = { walk_deg = 1.0 }", "key extrinsic.drift.x_wf.walk_deg: unknown key"),
        ("x_wf = { walk_um = -1.0 }", "key extrinsic.drift.x_wf.walk_um: expected a number from 0"),
        ("x_wf = { bounded_sd_um = 1.0 }", "expected bounded_hours and bounded_sd_um together"),
        ("x_wf = { bounded_hours = 1.0 }", "expected bounded_hours and bounded_sd_um together"),
        ("x_wf = 3", "key extrinsic.drift.x_wf: expected a table"),
        ("x_wf = { walk_um = nan }", "expected a finite number"),
    ],
)
def test_what_is_refused(tmp_path, drift, message):
    with pytest.raises(InputError, match=message):
        cell_with(tmp_path, drift)


def test_sizes_leave_the_hash_of_the_cell_alone(tmp_path):
    one, two = (cell_with(tmp_path, f"x_wf = {{ walk_um = {size} }}") for size in (0.5, 0.6))
    assert one.sha256 == two.sha256 == load_cell(mechanics="none").sha256
    assert one.drift[0].content() != two.drift[0].content()


def test_a_joint_names_its_own(tmp_path):
    line = "theta = { nominal_deg = 0.0, prior_sd_deg = 1.0 }"
    path = tmp_path / "cell.toml"
    path.write_text(TEXT.replace(line, f"{line}\ndrift = {{ theta = {{ walk_deg = 1.0 }} }}"))
    sizes = load_cell(path, mechanics="none").drift
    assert [size.name for size in sizes] == ["theta_4", "theta_6"]
    path.write_text(TEXT.replace(line, f"{line}\ndrift = {{ r = {{ walk_um = 1.0 }} }}", 1))
    with pytest.raises(InputError, match=r"key joint 4\.drift\.r: unknown key"):
        load_cell(path, mechanics="none")
