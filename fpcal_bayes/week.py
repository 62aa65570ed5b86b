"""The paper's week on the simulated cell: sweeps on days 0, 1, 2, 7 and 8, each identified as the paper did.

Between the tables of the paper the truth either moves steadily, or walks at random with the drift sizes of the cell.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fpcal_bayes.infer.identify import Identification, identify
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.rig import simulate
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cell import Cell

#: How the truth gets from one table to the next.
BETWEEN = ("steady", "walk")
_STEP_H = 0.5

Free = Literal["all", "extrinsic"]


@dataclass(frozen=True)
class Session:
    """One session of the week.

    Attributes
    ----------
    name, day
        As in the campaign.
    free
        What is identified; the rest is held at the last full identification.
    tables
        The tables of the paper that it makes anew.
    """

    name: str
    day: float
    free: Free
    tables: str


SESSIONS = (
    Session("full-T0", 0.0, "all", "Tables II and III"),
    Session("full-day1", 1.0, "all", "Tables V and IV"),
    Session("full-day2", 2.0, "all", "Tables VI and IV"),
    Session("extrinsic-day7", 7.0, "extrinsic", "Table IV"),
    Session("full-day8", 8.0, "all", "Tables VII and IV"),
)


@dataclass(frozen=True)
class Week:
    """What the week gave: the truth, the sweeps of all sessions, and an identification of each."""

    cell: Cell
    truth: Truth
    sweeps: Sweeps
    identifications: dict[str, Identification]


def week_truth(cell: Cell, between: str, seed: int) -> Truth:
    """The truth through the week: the paper's tables on days 0, 1, 2 and 8, and what lies between them.

    Parameters
    ----------
    between
        One of `BETWEEN`: ``steady``, or ``walk`` for a random walk with the cell's drift sizes, given the tables.
    seed
        Of the walk.
    """
    tables = paper_truth(cell)
    if between == "steady":
        return tables
    sizes = {size.name: size.walk for size in cell.drift}
    walk = np.array([sizes.get(name, 0.0) for name in tables.parameters.names]) * np.sqrt(_STEP_H / 24.0)
    times = np.arange(0.0, tables.times_h[-1] + _STEP_H / 2.0, _STEP_H)
    random = np.random.default_rng([seed, 2])
    path = np.cumsum(np.vstack([0.0 * walk, walk * random.standard_normal((len(times) - 1, len(walk)))]), axis=0)
    # A walk less its own line between the days of the tables is a Brownian bridge.
    at_tables = Truth(tables.parameters, tables.times_h, path[np.searchsorted(times, tables.times_h - 1e-9)])
    return Truth(tables.parameters, times, tables.at(times) + path - at_tables.at(times))


def measure_week(cell: Cell, *, sigma: float, seed: int, between: str = "steady") -> tuple[Truth, Sweeps]:
    """Simulate the sweeps of every session.

    Parameters
    ----------
    sigma
        Standard deviation of each change of cavity length, in um.
    seed
        Of the noise.
    between
        As in `week_truth`.

    Returns
    -------
    tuple
        The truth through the week, and the sweeps of all sessions in order of time.
    """
    truth = week_truth(cell, between, seed)
    plan = join([paper_protocol(cell, session=s.name, time_h=24.0 * s.day) for s in SESSIONS], file="week")
    return truth, simulate(cell, truth, plan, sigma=sigma, seed=seed)


def identify_session(
    cell: Cell, sweeps: Sweeps, session: Session, full: Identification | None, data: dict[str, str]
) -> Identification:
    """Identify one session; `full` is the last full identification, at which an extrinsic one holds the rest."""
    start = None if session.free == "all" or full is None else full.estimate
    result = identify(cell, sweeps.of_session(session.name), free=session.free, start=start)
    return replace(result, estimate=replace(result.estimate, data={**data, "session": session.name}))
