"""Compensation on the way to the joints: what an estimate knows of error motions, taken off a path."""

from dataclasses import replace

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics.compensation import compensated_path
from fpcal_bayes.motion.tasks import Task


def compensated_joints(
    estimate: Estimate, start: Floats, q: Floats, before: Floats | None = None
) -> tuple[Floats, Floats]:
    """As `compensated_path`, with what an estimate knows; the path as it is where that is a perfect mechanism."""
    known = estimate.mechanics
    if known is None:
        return q, np.zeros(len(q))
    model = CavityModel.of(estimate.cell, estimate.parameters)
    _, jacobian = model.predict_with_jacobian(estimate.values, model.rows(np.repeat(start[None], len(q), axis=0), q))
    weights, factor = known.known_motions
    geometry = jacobian @ known.geometry(estimate.parameters.names)[0]
    terms, vector = known.terms(estimate.cell), estimate.vector()
    return compensated_path(terms, vector, weights, start, q, before=before, geometry=geometry, return_factor=factor)


def compensated(estimate: Estimate, task: Task, before: Floats | None = None) -> Task:
    """A task whose joint path makes up for the error motions that the estimate knows, where it is driven and gains."""
    ok = task.ok
    if estimate.mechanics is None or not ok.any():
        return task
    q, added = task.q.copy(), np.zeros(len(task))
    q[ok], added[ok] = compensated_joints(estimate, task.start, q[ok], before)
    return replace(task, q=q, added=added, plain=task.q) if added.any() else task
