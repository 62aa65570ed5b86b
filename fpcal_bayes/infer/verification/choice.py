"""Which sweeps would show an error of the tasks: a validation session, chosen one sweep after the other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, special

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.design.candidates import SweepLimits, candidate_sweeps
from fpcal_bayes.infer.design.order import in_short_order
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.verification.expected import Expected
from fpcal_bayes.infer.verification.power import LEVEL, Effects, effects_of
from fpcal_bayes.infer.verification.verify import worthwhile
from fpcal_bayes.measure.protocol import read_often
from fpcal_bayes.measure.sweeps import Sweeps, pool
from fpcal_bayes.model.envelope import require_within_envelope
from fpcal_bayes.model.margin import estimate_draws

#: Sweeps that are chosen from, and readings of each.
_CANDIDATES, READINGS = 300, 4
_TOLERANCE = 0.05
#: What the strength of an error that is surely found already counts beside the power.
_BEYOND = 1e-3


@dataclass(frozen=True)
class ValidationPlan:
    """Sweeps that verify a calibration."""

    sweeps: Sweeps  # in the order in which they are driven, without readings in between
    readings: int  # of each
    power: dict[str, dict[str, float]]  # by task and kind of error: probability of finding one that is worth it


def validation_plan(
    found: Identification,
    n: int,
    *,
    readings: int = READINGS,
    sigma: float = 5e-3,
    limits: SweepLimits | None = None,
    tasks: Sequence[str] | None = None,
    radius: float | None = None,
    candidates: int = _CANDIDATES,
    seed: int = 0,
) -> ValidationPlan:
    """Choose `n` single-joint sweeps that would show errors of the tasks that a calibration promises too much of.

    Parameters
    ----------
    found
        The calibration.
    readings, sigma
        Of each sweep, and the standard deviation of a reading in um.
    limits
        Of the sweeps; the cell's envelope narrows them.
    tasks, radius
        As of `verify`, each with the cell's own tolerance, or 0.05 um; without one all.
    candidates
        Random sweeps to choose from.

    Raises
    ------
    InputError
        If the calibration is not to be used, a number is not above zero, or a sweep may leave the cell's envelope.
    """
    estimate, fitted, cell = found.estimate, found.problem.sweeps, found.estimate.cell
    if not estimate.trust.usable:
        raise InputError(f"{fitted.file}: the calibration is not to be used: {estimate.trust.against}")
    if n < 1 or not 0 < sigma < np.inf:
        raise InputError(f"{n} sweeps, sd {sigma:g} um of a reading: expected numbers above zero")
    model, draws = estimate_draws(estimate)
    limits = (limits or SweepLimits()).within_envelope(model, draws)
    number, rng = max(candidates, n), np.random.default_rng(seed)
    values = found.problem.values(found.solution.unknowns)
    whole = candidate_sweeps(cell, n=number, rng=rng, values=values, limits=limits, several=False)
    rows = pool([fitted, read_often(whole, readings).with_measurement(np.zeros(number * readings), sigma)])
    expected = Expected.of(found, rows, np.arange(len(rows)) < len(fitted))
    effects = effects_of(expected, worthwhile(estimate, tasks or None, _TOLERANCE, radius), seed=seed)
    sweep = np.repeat(np.arange(number), readings)
    chosen = choose(expected, effects, sweep, n)
    labels = np.array([f"v{i + 1}" for i in range(n)])
    sweeps = in_short_order(cell, replace(whole.take(np.array(chosen)), label=labels))
    require_within_envelope(model, draws, sweeps.q_start, sweeps.q_end, file="plan")
    rows_of = np.flatnonzero(np.isin(sweep, chosen))
    covariance: Floats = expected.covariance[np.ix_(rows_of, rows_of)]
    power = {task: Effects(kind.names, kind.rows[:, rows_of]).power(covariance) for task, kind in effects.items()}
    return ValidationPlan(sweeps, readings, power)


def choose(expected: Expected, effects: Mapping[str, Effects], sweep: Ints, n: int) -> list[int]:
    """The `n` sweeps that find most errors of the tasks; `sweep` numbers those of the fresh rows, shape (n_fresh,)."""
    together = [kind.rows for kind in effects.values()]
    shares = np.concatenate([np.full(len(rows), 1.0 / max(len(rows), 1)) for rows in together])
    n_sweeps, n_each = int(sweep.max()) + 1, int((sweep == 0).sum())
    # What is left of covariance and errors once the chosen rows are known.
    covariance, left, chosen = expected.covariance.copy(), np.vstack(together), list[int]()
    excess = np.zeros(len(left))
    for step in range(n):
        blocks = covariance.reshape(n_sweeps, n_each, n_sweeps, n_each)
        own = blocks[np.arange(n_sweeps), :, np.arange(n_sweeps), :] + np.eye(n_each) * 1e-15
        tall = left.reshape(len(left), n_sweeps, n_each).transpose(1, 2, 0)
        gains = (np.linalg.solve(np.linalg.cholesky(own), tall) ** 2).sum(axis=1)
        # Power, as `power_of` but for the tails: with the normal distribution of the same mean and variance.
        both, n_rows = excess + gains, (step + 1) * n_each
        likely = special.ndtr((both + n_rows - special.chdtri(n_rows, LEVEL)) / np.sqrt(2.0 * (n_rows + 2.0 * both)))
        worth = likely @ shares + _BEYOND * np.log1p(both) @ shares
        worth[chosen] = -np.inf
        best = int(np.argmax(worth))
        chosen.append(best)
        excess = excess + gains[best]
        rows = np.flatnonzero(sweep == best)
        gain = linalg.solve(covariance[np.ix_(rows, rows)], covariance[rows], assume_a="pos").T
        left = left - left[:, rows] @ gain.T
        covariance = covariance - gain @ covariance[rows]
        # A sweep that is chosen tells nothing a second time.
        covariance[np.ix_(rows, rows)] = np.eye(n_each)
        left[:, rows] = 0.0
    return chosen
