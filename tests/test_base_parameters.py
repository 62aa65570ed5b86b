"""Base parameters: as many as the rank, the same for any order and unit, and regrouped rightly."""

import numpy as np
import pytest

from fpcal_bayes.infer.fit.spectrum import spectrum_of
from fpcal_bayes.infer.observability.measures import BaseParameter, base_parameters
from fpcal_bayes.infer.observability.observe import whitened_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell

CELLS = {opd: load_cell(opd=opd, mechanics="none") for opd in ("axis", "perpendicular")}


def found_for(cell: Cell, sweeps: Sweeps) -> tuple[BaseParameter, ...]:
    jacobian = whitened_jacobian(CavityModel.of(cell), sweeps, paper_truth(cell).at(0.0))
    return base_parameters(spectrum_of(jacobian), cell.free)


def plan(cell: Cell, sigma: float, midpoints: bool = False) -> Sweeps:
    sweeps = paper_protocol(cell, midpoints=midpoints)
    return sweeps.with_measurement(np.zeros(len(sweeps)), sigma)


@pytest.mark.parametrize(
    ("opd", "midpoints", "rank"), [("axis", False, 16), ("axis", True, 17), ("perpendicular", False, 14)]
)
def test_there_are_as_many_as_the_rank(opd, midpoints, rank):
    base = found_for(CELLS[opd], plan(CELLS[opd], 0.005, midpoints))
    assert len(base) == rank
    kept = [b.name for b in base]
    assert kept == [name for name in CELLS[opd].free.names if name in kept]
    assert not {other for b in base for other, _ in b.shares} & set(kept)


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_order_of_sweeps_and_unit_of_noise_change_nothing(opd):
    cell = CELLS[opd]
    reference = found_for(cell, plan(cell, 0.005))
    random = np.random.default_rng(0)
    for sigma in (0.0001, 0.1):
        for _ in range(5):
            again = found_for(cell, plan(cell, sigma).take(random.permutation(69)))
            assert [b.name for b in again] == [b.name for b in reference]
            for one, other in zip(again, reference, strict=True):
                assert [name for name, _ in one.shares] == [name for name, _ in other.shares]
                np.testing.assert_allclose(
                    [factor for _, factor in one.shares], [factor for _, factor in other.shares], rtol=1e-4, atol=1e-7
                )


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_moving_along_the_regrouping_changes_no_prediction(opd):
    cell = CELLS[opd]
    sweeps, values = plan(cell, 0.005), paper_truth(cell).at(0.0)
    base = found_for(cell, sweeps)
    model = CavityModel.of(cell)
    rows = model.rows(sweeps.q_start, sweeps.q_end)
    kept = {b.name for b in base}
    for name in cell.free.names:
        if name in kept:
            continue
        # The data see base + factor * other: `other` moves by one and each base by minus its factor.
        shown = np.zeros(len(cell.free))
        shown[cell.free.position(name)] = 1.0
        for b in base:
            shown[cell.free.position(b.name)] = -dict(b.shares).get(name, 0.0)
        step = 0.01 * cell.free.to_internal(shown)
        ahead, behind = model.predict(values + step, rows), model.predict(values - step, rows)
        alone = np.where(np.arange(len(step)) == cell.free.position(name), step, 0.0)
        effect = np.abs(model.predict(values + alone, rows) - model.predict(values - alone, rows)).max()
        assert np.abs(ahead - behind).max() < 1e-5 * effect + 1e-7


def test_words():
    assert str(BaseParameter("x", (("y", 1.0), ("z", -0.25)))) == "x +1 y -0.25 z"
    assert BaseParameter("x", (("y", 2.0),)).content() == {"name": "x", "regrouped": [{"name": "y", "factor": 2.0}]}


def test_nothing_seen_has_no_base_parameters():
    assert base_parameters(spectrum_of(np.zeros((3, 21))), CELLS["axis"].free) == ()
