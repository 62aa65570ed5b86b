"""An estimate grows older."""

import numpy as np
import pytest

from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.tracking.drift import propagated


def test_a_random_walk_adds_its_variance(femto: Cell) -> None:
    free = femto.free
    known = Estimate(femto, free, free.nominal, np.diag((0.1 * free.prior_sd) ** 2), ("identified",) * len(free))
    older = propagated(known, 48.0)
    walks = {size.name: size.walk for size in femto.drift}
    expected = np.array([np.sqrt(2.0) * walks.get(name, 0.0) for name in free.names])
    grown = np.sqrt(np.diag(older.covariance - known.covariance))
    np.testing.assert_allclose(grown, expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(older.values, known.values)
    assert propagated(known, 1e-9).covariance == pytest.approx(known.covariance, rel=1e-6, abs=1e-12)
