"""Rows that are not what they seem: changes whose sign is not known, and fringe counts that slipped.

Both are judged against the predicted state: with a tracked cell, what a sweep will read is mostly known beforehand.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import linalg, sparse, special

from fpcal_bayes.core.linalg import chi2_tail, counted
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.fit.slips import MOST_HALF_WAVES
from fpcal_bayes.measure.sharing import sweep_numbers
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.drift import DriftModel, State
from fpcal_bayes.tracking.filter import Innovation, update
from fpcal_bayes.tracking.measurement import SweepMeasurement


@dataclass(frozen=True)
class RowChanges:
    """An innovation whose rows change by whole half wavelengths, by the Woodbury identity.

    With `w` half wavelengths off row i its square is ``squared - 2 w along[i] + w**2 size[i]``. With the Jacobian
    ``H = Q R`` the rows' inverse covariance is ``I - Q M Q'``, ``M = I - (I + R P R')^-1`` with a row per state.
    """

    squared: float  # normalised innovation squared, with the changes made so far
    along: Floats  # see above, shape (n_rows,)
    size: Floats  # likewise
    # product of the half wavelengths of each two rows without the state, shape (n_rows, n_rows), nearly all zero
    own: sparse.csc_array
    seen: Floats  # half a wavelength of each row along Q, shape (n_rows, n_states)
    weighed: Floats  # the same times M

    def taken_off(self, row: int, waves: int) -> Self:
        """With whole half wavelengths taken off one row."""
        squared = self.squared - 2.0 * waves * self.along[row] + waves**2 * self.size[row]
        along = self.along + waves * (self.weighed @ self.seen[row])
        entries = slice(self.own.indptr[row], self.own.indptr[row + 1])
        along[self.own.indices[entries]] -= waves * self.own.data[entries]
        return replace(self, squared=float(squared), along=along)


def row_changes(measurement: SweepMeasurement, predicted: State) -> RowChanges:
    """The changes of half a wavelength that the rows of a session, linearised at `predicted`, may have."""
    half_wave, whitening = measurement.model.half_waves(measurement.rows), measurement.whitening
    misfit, jacobian = measurement.linearise(predicted.mean)
    waves = sparse.csr_array(whitening.as_matrix @ sparse.diags_array(half_wave))
    directions, triangle = np.linalg.qr(jacobian)
    spread = np.eye(len(triangle)) + triangle @ predicted.covariance @ triangle.T
    explained = np.eye(len(triangle)) - np.linalg.inv(spread)
    left = misfit - directions @ (explained @ (directions.T @ misfit))
    own, seen = sparse.csc_array(waves.T @ waves), waves.T @ directions
    weighed = seen @ explained
    size = own.diagonal() - (seen * weighed).sum(axis=1)
    return RowChanges(float(misfit @ left), waves.T @ left, size, own, seen, weighed)


#: A predicted sign is taken when its odds exceed e^12 with a predictive standard deviation three times as wide.
_DECISIVE_LOG_ODDS = 12.0
_WIDENING = 3.0
#: Probability of a slip somewhere in a session, and of a jump of the parameters before it.
_SLIP = 1e-3
_JUMP = 1e-3
#: A slip is corrected when it is this much likelier than anything else (e^7: a thousand times).
_DECISIVE = 7.0
#: Half wavelengths that a count may slip by.
_WAVES = np.array([k for k in range(-MOST_HALF_WAVES, MOST_HALF_WAVES + 1) if k])
#: Probability of the corrected innovation that a correction must reach.
_ACCEPT = 1e-3


def with_signs(drift: DriftModel, model: CavityModel, predicted: State, sweeps: Sweeps) -> tuple[Sweeps, list[str]]:
    """The rows with the signs that the state predicts, and a warning if rows that stay open were left out."""
    known = sweeps.signed | sweeps.absolute
    if known.all():
        return sweeps, []
    dl = sweeps.dl.copy()
    while not known.all():
        state = predicted
        if known.any():
            part = sweeps.take(known).with_measurement(dl[known], sweeps.sigma[known])
            state = update(predicted, SweepMeasurement.of(drift, model, part, predicted.mean)).state
        expected, jacobian = model.predict_with_jacobian(drift.values(state.mean), sweeps.laid_out(model))
        scaled, n = jacobian * drift.scale, drift.n_lengths
        if drift.motions is not None:
            _, felt = drift.motions.rows(model, sweeps, drift.values(state.mean))
            scaled = np.hstack([scaled, felt])
            expected = expected + felt @ state.mean[drift.n_parameters : n]
        variance = ((scaled @ state.covariance[:n, :n]) * scaled).sum(axis=1) + sweeps.sigma**2
        clear = ~known & (2.0 * np.abs(expected) * np.abs(dl) > _DECISIVE_LOG_ODDS * _WIDENING**2 * variance)
        if not clear.any():
            break
        dl[clear] = np.copysign(dl[clear], expected[clear])
        known |= clear
    signed = sweeps.with_measurement(dl, sweeps.sigma).take(known)
    left = int((~known).sum())
    if not left:
        return signed, []
    named = ", ".join(sweeps.label[~known].tolist()[:5]) + (", ..." if left > 5 else "")
    return signed, [f"the sign of {counted(left, 'row')} cannot be told: not used: {named}"]


def correct_slips(
    sweeps: Sweeps, measurement: SweepMeasurement, innovation: Innovation, predicted: State, jumps: tuple[Floats, ...]
) -> tuple[Floats, list[str]]:
    """Take whole half wavelengths off signed rows if that explains a large innovation far better than all else.

    Gives dL (n_rows,), in um, corrected or not, and what is to be said; `jumps` (n_states,) are sd of likely ones.
    """
    half_wave, count = measurement.model.half_waves(measurement.rows), len(sweeps)
    rows, dl = row_changes(measurement, predicted), sweeps.dl.copy()
    changes = np.zeros(count, dtype=np.int64)
    log_odds = float(np.log(_SLIP / (2 * MOST_HALF_WAVES * count)))
    gain = _other_gains(innovation, predicted, jumps)
    evidence, needed = 0.0, (count + 1) // 2
    for _ in range(needed):
        # What is left of the square after each further correction.
        left = rows.squared - 2.0 * _WAVES[:, None] * rows.along + _WAVES[:, None] ** 2 * rows.size
        left = np.where(changes == 0, left, np.inf)
        at, row = (int(i) for i in np.unravel_index(np.argmin(left), left.shape))
        waves, squared = int(_WAVES[at]), float(left[at, row])
        if _most(evidence, log_odds, innovation, rows.squared, left) < gain - 2.0 * _DECISIVE:
            return sweeps.dl, []
        evidence += log_odds
        changes[row] = waves
        rows = rows.taken_off(row, waves)
        dl[row] -= waves * half_wave[row]
        if chi2_tail(squared, count) > _ACCEPT:
            break
    else:
        return sweeps.dl, []
    named = ", ".join(f"{sweeps.label[i]} ({-changes[i]:+d})" for i in np.flatnonzero(changes))
    best = innovation.log_likelihood + gain
    slipped = evidence + innovation.log_likelihood + 0.5 * (innovation.squared - squared)
    if slipped < best + _DECISIVE:
        doubt = f"slipped fringe counts would explain the session about as well: {named}"
        return sweeps.dl, [doubt] if slipped > best - _DECISIVE else []
    return dl, [f"fringe counts slipped, corrected by whole half wavelengths: {named}"]


def outlying_sweep(
    sweeps: Sweeps, measurement: SweepMeasurement, innovation: Innovation, predicted: State, jumps: tuple[Floats, ...]
) -> Ints | None:
    """Rows of the sweep whose Student-3 noise explains an innovation best; None: a change of the cell does."""
    misfit, jacobian = measurement.linearise(predicted.mean)
    own = measurement.whitening.apply(np.eye(len(misfit)))
    solved = linalg.cho_solve(
        linalg.cho_factor(np.eye(len(misfit)) + jacobian @ predicted.covariance @ jacobian.T),
        np.column_stack([own, misfit]),
    )
    inverse, along, noise = own.T @ solved[:, :-1], own.T @ solved[:, -1], own.T @ own
    best, chosen = _other_gains(innovation, predicted, jumps), None
    numbers = sweep_numbers(sweeps)
    for number in range(int(numbers.max()) + 1):
        rows = np.flatnonzero(numbers == number)
        at = np.ix_(rows, rows)
        away = np.linalg.solve(inverse[at], along[rows])
        p, far = len(rows), float(away @ noise[at] @ away)
        tails = (
            special.gammaln((3 + p) / 2) - special.gammaln(1.5) - (3 + p) / 2 * np.log1p(far) - p / 2 * np.log(np.pi)
        )
        normal = -0.5 * (float(away @ along[rows]) + p * np.log(2.0 * np.pi))
        gain = float(tails - normal + 0.5 * (np.linalg.slogdet(noise[at])[1] - np.linalg.slogdet(inverse[at])[1]))
        if gain > best:
            best, chosen = gain, rows
    return chosen


def _other_gains(innovation: Innovation, predicted: State, jumps: tuple[Floats, ...]) -> float:
    """What chance, a jump of `jumps`, or one of one parameter gains in log likelihood, rarity taken off."""
    gains = [0.0]
    rarity = float(np.log(_JUMP))
    for jump in jumps:
        wide = innovation.under(predicted.covariance + np.diag(jump**2))
        gains.append(rarity + wide.log_likelihood - innovation.log_likelihood)
    moving = np.flatnonzero(jumps[-1])
    columns = innovation.whiten(innovation.jacobian[:, moving] * jumps[-1][moving])
    size = (columns**2).sum(axis=0)
    alone = 0.5 * ((columns.T @ innovation.whitened) ** 2 / (1.0 + size) - np.log1p(size))
    return max(*gains, rarity - float(np.log(len(moving))) + float(alone.max()))


def _most(evidence: float, log_odds: float, innovation: Innovation, squared: float, left: Floats) -> float:
    """Most that slips can raise the log likelihood; among few rows one more may explain all that is left."""
    if len(innovation.misfit) == innovation.dof:
        return evidence + log_odds + 0.5 * innovation.squared
    falls = squared - left.min(axis=0)
    if falls.max() <= 0.0:
        return -np.inf
    further = np.maximum(0.5 * falls + log_odds, 0.0).sum()
    return float(evidence + 0.5 * (innovation.squared - squared) + further)
