"""A true cell, an estimate of it, and what the tests of tasks share."""

from dataclasses import replace

import numpy as np

from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate


def paper_values(cell: Cell) -> np.ndarray:
    """Tables II and III, in um and rad."""
    return paper_truth(cell).values[0]


def paper_estimate(cell: Cell, *, midpoints: bool = False, independent: bool = False) -> Estimate:
    """Tables II and III with the covariance that the paper's sweeps leave at 5 nm noise.

    With `independent` the midpoint of a sweep does not share the reading at its start.
    """
    plan = paper_protocol(cell, midpoints=midpoints)
    sweeps = plan.with_measurement(np.zeros(len(plan)), np.full(len(plan), 0.005))
    if independent:
        sweeps = replace(sweeps, group=np.full(len(sweeps), "", dtype=sweeps.group.dtype))
    values = paper_values(cell)
    problem = Problem.of(CavityModel.of(cell), sweeps)
    unknowns = problem.unknowns(values)
    covariance = problem.relinearised(unknowns).covariance(unknowns)
    return Estimate(cell, cell.free, values, covariance, ("identified",) * len(values))
