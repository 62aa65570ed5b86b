"""Directions that the data do not see: grouped, named, and right on a chain worked out by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.infer.fit.spectrum import spectrum_of
from fpcal_bayes.infer.observability.gauges import MEMBER_SHARE, Gauge, find_gauges, random_poses
from fpcal_bayes.infer.observability.observe import whitened_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell

CELLS = {opd: load_cell(opd=opd, mechanics="none") for opd in ("axis", "perpendicular")}
XY_THETA = Path(__file__).parent / "data" / "xy-theta.toml"


def draw(cell: Cell, random: np.random.Generator) -> np.ndarray:
    return cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))


def gauges_of(cell: Cell, sweeps: Sweeps, values: np.ndarray) -> list[Gauge]:
    model = CavityModel.of(cell)
    return find_gauges(model, values, spectrum_of(whitened_jacobian(model, sweeps, values)).null_space)


def plan(cell: Cell, sigma: float = 0.005) -> Sweeps:
    return paper_protocol(cell).with_measurement(np.zeros(69), sigma)


def test_groups_of_the_axis_path_at_fifty_truths():
    cell, random, complete = CELLS["axis"], np.random.default_rng(1), 0
    for _ in range(50):
        gauges = gauges_of(cell, plan(cell), draw(cell, random))
        assert [g.layer for g in gauges] == ["model", "model", "model", "absolute", "sweeps"]
        last, shift, turn, slide, offset = gauges
        # At most one of the tilts may be so small that the other hardly moves.
        assert last.parameters[0] == "theta_6"
        assert 2 <= len(last.parameters) <= 3
        assert set(last.parameters) <= {"theta_6", "theta_et", "beta_et"}
        complete += len(last.parameters) == 3
        assert "offset of the last joint (theta_6)" in last.explanation
        assert shift.parameters[0] == "d_4"
        assert {"d_4", "y_wf"} <= set(shift.parameters) <= {"d_4", "x_wf", "y_wf", "z_wf"}
        assert "shifts the mirror by the same vector at every pose" in shift.explanation
        assert set(turn.parameters[:2]) == {"theta_3", "theta_4"}
        assert turn.explanation.startswith("theta_3 and theta_4 turn about one axis; only their sum shows")
        assert slide.parameters[0] == "y_wf"
        assert "sliding the fibre along its axis" in slide.explanation
        assert offset.parameters[0] in ("d_5", "z_et")
        assert {"d_5", "z_et"} <= set(offset.parameters)
        assert "midpoint" in offset.remedy
    assert complete >= 48


def test_groups_of_the_perpendicular_path_at_fifty_truths():
    cell, random = CELLS["perpendicular"], np.random.default_rng(2)
    for _ in range(50):
        gauges = gauges_of(cell, plan(cell), draw(cell, random))
        by_parameters = {g.parameters: g for g in gauges}
        for name in ("beta_wf", "theta_wf"):
            assert by_parameters[(name,)].layer == "model"
            assert by_parameters[(name,)].explanation == f"no cavity length depends on {name}"
        assert by_parameters[("z_et",)].layer == "absolute"
        assert ("y_wf",) not in by_parameters
        (offset,) = [g for g in gauges if g.layer == "sweeps"]
        assert {"d_5", "y_wf"} <= set(offset.parameters)
        assert len(gauges) == 7


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_order_of_sweeps_and_noise_change_nothing(opd):
    cell, random = CELLS[opd], np.random.default_rng(3)
    values = draw(cell, random)
    reference = gauges_of(cell, plan(cell), values)
    for sigma in (0.0001, 0.1):
        again = gauges_of(cell, plan(cell, sigma).take(random.permutation(69)), values)
        assert [(g.layer, g.parameters) for g in again] == [(g.layer, g.parameters) for g in reference]
        for one, other in zip(again, reference, strict=True):
            np.testing.assert_allclose(one.direction, other.direction, rtol=1e-3, atol=1e-4)


def test_no_null_space_no_gauges():
    cell = CELLS["axis"]
    assert find_gauges(CavityModel.of(cell), cell.free.nominal, np.zeros((0, 21))) == []


def test_fibre_parameters_alone_get_a_sentence():
    # A single pose with an absolute length: everything but one combination is unseen.
    cell = CELLS["axis"]
    sweeps = plan(cell).take(np.array([0]))
    values = draw(cell, np.random.default_rng(4))
    gauges = gauges_of(cell, sweeps, values)
    assert len(gauges) == 20
    assert all(g.explanation and g.remedy and len(g.parameters) == len(g.direction) for g in gauges)


# The chain of xy-theta.toml, i-1Ti = RotY(beta) RotX(alpha) TransX(d) RotZ(theta) TransZ(r):
#
# r_1: z1 = RotY(90 deg) z = Xw whatever is free, so r_1 shifts the mirror by Xw. L depends on o - f only:
#   (r_1, x_wf) = (1, 1).
# r_2: z2 = RotY(90 deg) RotX(alpha_2) z = (cos alpha_2, -sin alpha_2, 0), the same at every pose since no joint has
#   turned yet: (r_2, x_wf, y_wf) = (1, cos alpha_2, -sin alpha_2).
# theta_4: RotY(90 deg) takes x to -z, so RotZ(theta_4) RotY(90 deg) RotX(alpha_5) = RotZ(theta_4 - alpha_5)
#   RotY(90 deg), and d_5 = r_4 = 0: (theta_4, alpha_5) = (1, 1).
# theta_5: the mirror's origin (0, 0, z_et) lies on the axis of joint 5; its normal in frame 5 is m = (sin t,
#   -sin b cos t, cos b cos t) with b = beta_et, t = theta_et. RotZ(-1) turns it by dm = (m_y, -m_x, 0):
#   cos t dt = -sin b cos t gives dt = -sin b; -cos b cos t db + sin b sin t dt = -sin t gives db = cos b tan t.
# On the axis path f + s a changes every L by -s: (x_wf, y_wf, z_wf) = a = (sin th, -cos th cos be, -cos th sin be).
# On the perpendicular path L = |n.(o - f)| knows no a: beta_wf and theta_wf are unseen. z_et moves o along z5, and
#   n.z5 = m_z is the same at every pose: unseen by differences. f + s a is seen, for n.a differs from pose to pose.
def by_hand(cell: Cell, values: np.ndarray) -> tuple[list[dict[str, float]], dict[str, float]]:
    """Null directions of the model, and the one that an absolute length shows, in shown units."""
    v = dict(zip(cell.free.names, values.tolist(), strict=True))
    b, t, be, th = v["beta_et"], v["theta_et"], v["beta_wf"], v["theta_wf"]
    always = [
        {"r_1": 1.0, "x_wf": 1.0},
        {"r_2": 1.0, "x_wf": np.cos(v["alpha_2"]), "y_wf": -np.sin(v["alpha_2"])},
        {"theta_4": 1.0, "alpha_5": 1.0},
        {"theta_5": 1.0, "beta_et": np.cos(b) * np.tan(t), "theta_et": -np.sin(b)},
    ]
    if cell.opd == "perpendicular":
        return [*always, {"beta_wf": 1.0}, {"theta_wf": 1.0}], {"z_et": 1.0}
    return always, {"x_wf": np.sin(th), "y_wf": -np.cos(th) * np.cos(be), "z_wf": -np.cos(th) * np.sin(be)}


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_another_chain_worked_out_by_hand(opd):
    cell = load_cell(XY_THETA, opd=opd, mechanics="none")
    model, random = CavityModel.of(cell), np.random.default_rng(5)
    for _ in range(20):
        values = draw(cell, random)
        poses = random_poses(model, random, 120)
        sweeps = Sweeps.of_um_rad(poses[:60], poses[60:], dl=0.0, sigma=0.005)
        spectrum = spectrum_of(whitened_jacobian(model, sweeps, values))
        always, slide = by_hand(cell, values)
        assert spectrum.rank == len(cell.free) - len(always) - 1
        assert spectrum.gap > 1e6
        for direction in [*always, slide]:
            unit = cell.free.from_mapping(dict.fromkeys(cell.free.names, 0.0) | direction) / cell.free.prior_sd
            unit /= np.linalg.norm(unit)
            np.testing.assert_allclose(spectrum.null_space.T @ (spectrum.null_space @ unit), unit, atol=1e-6)

        gauges = find_gauges(model, values, spectrum.null_space)
        assert sorted(g.layer for g in gauges) == ["absolute", *["model"] * len(always)]
        # A member that hardly moves is left out of its group.
        sd = {p.name: p.shown(p.prior_sd) for p in cell.free}
        for direction in [*always, slide]:
            largest = max(abs(move) / sd[name] for name, move in direction.items())
            for name in [n for n, move in direction.items() if abs(move) / sd[n] < MEMBER_SHARE * largest]:
                del direction[name]
        expected = {frozenset(direction) for direction in always}
        assert {frozenset(g.parameters) for g in gauges if g.layer == "model"} == expected
        for gauge in gauges:
            direction = next((d for d in always if set(d) == set(gauge.parameters)), slide)
            found = dict(zip(gauge.parameters, gauge.direction, strict=True))
            lead = gauge.parameters[0]
            for name, move in direction.items():
                limit = 1e-6 * abs(found[lead]) / sd[lead] * sd[name]
                assert found[name] == pytest.approx(move * found[lead] / direction[lead], rel=1e-4, abs=limit)
        lead = {"axis": "y_wf", "perpendicular": "z_et"}[opd]
        assert next(g for g in gauges if g.layer == "absolute").parameters[0] == lead


def test_the_other_chain_seen_with_an_absolute_length():
    cell = load_cell(XY_THETA, mechanics="none")
    model, random = CavityModel.of(cell), np.random.default_rng(6)
    poses, values = random_poses(model, random, 120), draw(cell, random)
    sweeps = Sweeps.of_um_rad(poses[:60], poses[60:], dl=0.0, sigma=0.005)
    sweeps = replace(sweeps, kind=np.where(np.arange(60) == 7, "absolute", sweeps.kind))
    gauges = gauges_of(cell, sweeps, values)
    assert [g.layer for g in gauges] == ["model"] * 4
