"""Expected fading of the fringes along the sweeps of a cell."""

import numpy as np

from fpcal_bayes.fringes.ingest import fading_priors
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.interferometer import mirror_amplitude, mirror_views


def test_the_truths_fading_is_expected(femto: Cell) -> None:
    """A tilt loses light towards its ends, a translation does not; the paper's truth lies within the priors."""
    plan, truth = paper_protocol(femto), paper_truth(femto)
    model = CavityModel.of(femto, truth.parameters)
    s = np.linspace(-1.0, 1.0, 31)
    expected = fading_priors(femto, plan)
    for row in (0, 1, 2, 45, 46, 60):
        middle, half = (plan.q_start[row] + plan.q_end[row]) / 2, (plan.q_end[row] - plan.q_start[row]) / 2
        _, distance, tilt = mirror_views(model, truth.at(0.0), middle + s[:, None] * half)
        true = np.polynomial.legendre.legfit(s, np.log(mirror_amplitude(femto.interferometer, distance, tilt)), 4)[1:]
        off = (true - np.array(expected[row].fade_mean)) / np.array(expected[row].fade)
        assert np.abs(off).max() < 3.0
    assert expected[0].fade_mean[1] < -0.3
    assert np.abs(expected[45].fade_mean).max() < 0.01
