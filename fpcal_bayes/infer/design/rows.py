"""What candidate sweeps and tasks look like to the design: derivatives by the free parameters, over draws."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.noise import whitening_of
from fpcal_bayes.measure.protocol import read_often
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel


def sweep_rows(
    model: CavityModel, values: Floats, sweeps: Sweeps, *, readings: int = 2, sigma: float = 0.005
) -> Floats:
    """Whitened derivatives of the rows of each sweep, shape (n_draws, n_sweeps, readings, n_free), per um or rad.

    They are linearised at `values` (n_draws, n_free), in um and rad. `sweeps` are a plan of whole sweeps; there are
    `readings` of each after its start: 1 end point, 2 midpoint and end point, and so on. `sigma` is the standard
    deviation of a row in um.
    """
    plan = read_often(sweeps, readings)
    whitened = plan_rows(model, values, replace(plan, sigma=np.full(len(plan), sigma)))
    return whitened.reshape(len(whitened), len(sweeps), readings, -1)


def plan_rows(model: CavityModel, values: Floats, sweeps: Sweeps) -> Floats:
    """Whitened derivatives of the rows of a plan with standard deviations, shape (n_draws, n_rows, n_free)."""
    rows = model.rows(sweeps.q_start, sweeps.q_end, sweeps.absolute)
    values = np.atleast_2d(values)
    _, jacobians = model.predict_with_jacobian(values, rows)
    whitening = whitening_of(model, sweeps, values[0])
    if not model.cell.repeatability.any():
        return whitening.apply(jacobians)
    # What the joints' repeatability adds depends on where the rows are linearised.
    parts: Sequence[Floats] = [
        whitening_of(model, sweeps, point).apply(jacobian) for point, jacobian in zip(values, jacobians, strict=True)
    ]
    return np.array(parts)
