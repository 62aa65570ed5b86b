"""Rows of candidates are those of the observability analysis."""

from dataclasses import replace

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.design.rows import sweep_rows
from fpcal_bayes.infer.observability.observe import whitened_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import add_midpoints, paper_protocol, read_often
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell


@pytest.mark.parametrize("repeatability", [0.0, 1e-3])
def test_midpoints_as_the_protocol_has_them(femto: Cell, repeatability: float) -> None:
    joints = tuple(replace(joint, repeatability=repeatability) for joint in femto.joints)
    cell = replace(femto, joints=joints)
    model, plan = CavityModel.of(cell), paper_protocol(cell)
    draws = cell.free.nominal + 0.3 * cell.free.prior_sd * np.array([[0.0], [1.0]])
    halved = add_midpoints(plan)
    halved = replace(halved, sigma=np.full(len(halved), 0.005))
    found = sweep_rows(model, draws, plan, readings=2) * cell.free.prior_sd
    for rows, values in zip(found, draws, strict=True):
        expected = whitened_jacobian(model, halved, values)
        np.testing.assert_allclose(rows.reshape(138, 21), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_readings_are_evenly_spaced(femto: Cell) -> None:
    plan = paper_protocol(femto).take(np.arange(3))
    often = read_often(plan, 4)
    check_sweeps(often, femto)
    assert len(often) == 12
    assert len(set(often.group)) == 3
    np.testing.assert_allclose(often.q_end[3::4], plan.q_end)
    np.testing.assert_allclose(often.q_end[0::4], plan.q_start + (plan.q_end - plan.q_start) / 4)
    assert (read_often(plan, 1).group == "").all()
    with pytest.raises(InputError, match="0 readings: expected one at least"):
        read_often(plan, 0)


@pytest.mark.parametrize("cell", [*(load_cell(opd=opd) for opd in ("axis", "perpendicular")), load_cell("three-beams")])
def test_pulls_of_joints_against_differences(cell: Cell) -> None:
    model, rng = CavityModel.of(cell), np.random.default_rng(0)
    values = cell.free.nominal + 0.3 * rng.normal(size=(3, len(cell.free))) * cell.free.prior_sd
    scales = np.where(cell.revolute, 1.0, 1000.0)
    n, beam = len(scales), len(cell.beams) - 1
    q = rng.uniform(-0.05, 0.05, (4, n)) * scales
    pulls = rng.normal(size=(3, 4, len(cell.free)))

    def pulled(poses: Floats) -> float:
        _, jacobian = model.predict_with_jacobian(values, model.pose_rows(poses, np.full(len(poses), beam)))
        return (jacobian * pulls).sum(axis=(0, 2))

    steps = np.diag(1e-5 * scales)
    differences = np.stack([(pulled(q + step) - pulled(q - step)) / (2.0 * step.max()) for step in steps], axis=1)
    found = model.joint_pulls(values, q, pulls, beam, 1e-6 * scales)
    np.testing.assert_allclose(found, differences, atol=1e-8 * np.abs(differences).max())
