"""Fit the irradiance itself: every sample of every trace, from an estimate that is already good to a part of a fringe.

    I = a(t) + m e^2 + e b(t) cos(p) + e (h cos(2 p) + g sin(2 p)),    p = 4 pi n L(q(t); v) / lambda + phase

Nothing is counted and no end points are taken. Mean a and amplitude b of each trace are slow polynomials of the time,
the light m from the mirror alone, the second harmonic (h, g) and the phase are free; e is how the fringes fade as the
mirror tilts. These nuisances are eliminated trace by trace (variable projection: G. Golub, V. Pereyra, SIAM J. Numer.
Anal. 10, 413 (1973), with the Gauss-Newton matrix of L. Kaufman, BIT 15, 49 (1975)), so that each step solves for the
free parameters alone.

The interior of a sweep tells what its end points do not: between them even terms of L cancel in a symmetric turn.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import linalg

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import posterior_triangle
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.infer.fit.spectrum import spectrum_of, statuses
from fpcal_bayes.infer.traces.kernels import trace_grams
from fpcal_bayes.infer.traces.samples import NODES, TraceSamples
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet

#: Coefficients of the polynomials of mean and amplitude.
_DEGREE = 3
#: Standard deviation of the coefficients beyond the first, relative to the first: slow drift, not fringes.
_DRIFT = 0.1
#: Nuisances of a trace: a, b, m, h, g, phase.
_LEVELS = 2 * _DEGREE + 4
#: Standard deviation of the second harmonic relative to the fringes.
_HARMONIC = 0.05
#: Standard deviation of what is free, in V or rad.
_FREE = 1e4
#: A further step would lower the sum of squares by less than this.
_DECREMENT = 1e-6
#: Where rounding lets no step go down, this much of a decrement is still a minimum.
_STUCK = 1e-2
#: How often noise and envelopes are worked out anew.
_ROUNDS = 5
#: Residuals this many times the photodiode's noise: the model does not follow the trace.
_OFF = 3.0


@dataclass(frozen=True, eq=False)
class TraceFit:
    """Result of `fit_traces`."""

    estimate: Estimate  # maximum of the posterior with its Laplace covariance
    labels: tuple[str, ...]
    residual: Floats  # standard deviation of each trace's irradiance around the fit, in V, shape (n_traces,)
    noise: Floats  # what the fit took as the noise of a sample, in V, shape (n_traces,)
    # coefficients of mean a and amplitude b, then m, h and g, all in V, and the phase of each trace, (n_traces, 10)
    levels: Floats
    # n_samples, rank, steps: samples used, rank of the Jacobian, Gauss-Newton steps taken
    n_samples: int
    rank: int
    steps: int
    converged: bool  # whether a further step would change nothing
    seconds: float  # time of the fit
    warnings: tuple[str, ...]  # sentences about what is not to be trusted

    def content(self) -> dict[str, Any]:
        """For JSON, without schema and command."""
        return {
            **self.estimate.content(),
            "fit": {
                "n_sweeps": len(self.labels),
                "n_samples": self.n_samples,
                "rank": self.rank,
                "steps": self.steps,
                "converged": self.converged,
                "seconds": self.seconds,
            },
            "traces": [
                {"label": label, "residual_v": float(residual), "noise_v": float(noise)}
                for label, residual, noise in zip(self.labels, self.residual, self.noise, strict=True)
            ],
            "warnings": list(self.warnings),
        }


def fit_traces(
    cell: Cell,
    index: TraceIndex,
    start: Estimate,
    *,
    free: str | Sequence[str] = "all",
    prior: Estimate | None = None,
    length_noise: float = 0.0,
    max_steps: int = 40,
) -> TraceFit:
    """Fit free parameters to the irradiance of traces.

    Parameters
    ----------
    index
        Sweeps of one session with their traces; rows without a trace are left out.
    start
        Where to begin; its lengths along each sweep must be right to a quarter of a fringe.
    free
        As in `identify`; parameters that are not free are held at `start` as exact.
    prior
        An earlier estimate from other data whose values and covariance are the prior; by default that of the cell.
        Not `start`, if it was made from the same sweeps: they would count twice.
    length_noise
        Standard deviation of independent noise on the cavity length at each sample (vibration), in um. Where it is
        given, the noise of the photodiode is the cell's; else it is that of each trace's residuals.
    max_steps
        Gauss-Newton steps at most.
    """
    began = time.perf_counter()
    chosen = cell.select(free)
    if not len(chosen):
        raise InputError("nothing is free: expected at least one parameter to identify")
    model = CavityModel.of(cell, chosen, start.vector())
    values = start.vector()[chosen.slots]
    samples = TraceSamples.of(model, values, index)
    if (samples.counts < 2 * _LEVELS).any():
        short = int(np.argmin(samples.counts))
        raise InputError(f"trace {samples.labels[short]!r}: {samples.counts[short]} samples are too few to fit")
    knowledge = Prior.of(chosen) if prior is None else Prior.joint(chosen, prior)
    fit = _Fit(model, samples, samples.rows(model), knowledge, length_noise)
    state = fit.begin(knowledge.scores(values))
    steps = 0
    # Noise and envelopes are those of the fit, so they settle with it.
    for _ in range(_ROUNDS):
        state, taken, converged = fit.descend(state, max_steps - steps)
        steps += taken
        before = state
        fit = replace(fit, samples=samples.seen_by(model, knowledge.values(state.scores)))
        state = fit.with_noise(state)
        change = np.abs(fit.samples.envelope - samples.envelope).max()
        samples = fit.samples
        if change < 1e-5 and np.allclose(state.noise, before.noise, rtol=1e-3):
            break
    state, taken, converged = fit.descend(state, max(max_steps - steps, 2))
    return _result(fit, state, chosen, index, start, steps + taken, converged, time.perf_counter() - began)


@dataclass(frozen=True, eq=False)
class _State:
    """A point of the fit: scores of the parameters, nuisances, noise, and what the kernel says of it."""

    scores: Floats
    levels: Floats
    noise: Floats
    slopes: Floats
    grams: Floats
    squares: Floats
    total: float


@dataclass(frozen=True, eq=False)
class _Fit:
    model: CavityModel
    samples: TraceSamples
    rows: Rows
    prior: Prior
    length_noise: float

    def begin(self, scores: Floats) -> _State:
        """Nuisances by linear least squares at the starting parameters, noise from their residuals."""
        s = self.samples
        series, _ = s.series(self.model, self.prior.values(scores), self.rows)
        levels, noise = np.zeros((len(s), _LEVELS)), np.empty(len(s))
        for i in range(len(s)):
            part = slice(s.first[i], s.first[i + 1])
            length = np.polynomial.chebyshev.chebval(s.place[part], np.concatenate([[0.0], series[i]]))
            phase = s.wave_number[i] * length
            powers = s.time[part, None] ** np.arange(_DEGREE)
            waves = s.envelope[part, None] * np.column_stack([np.cos(phase), -np.sin(phase)])
            basis = np.hstack([powers, waves])
            found = np.linalg.lstsq(basis, s.irradiance[part])[0]
            levels[i, :_DEGREE] = found[:_DEGREE]
            levels[i, _DEGREE] = np.hypot(found[-2], found[-1])
            levels[i, -1] = np.arctan2(found[-1], found[-2])
            left = s.irradiance[part] - basis @ found
            noise[i] = np.sqrt(left @ left / max(len(left) - basis.shape[1], 1))
        if self.length_noise:
            noise[:] = self.model.cell.interferometer.noise
        return self.look(scores, levels, self._floor(noise))

    def look(self, scores: Floats, levels: Floats, noise: Floats) -> _State:
        """What the samples say at a point."""
        s = self.samples
        series, slopes = s.series(self.model, self.prior.values(scores), self.rows)
        grams, squares = trace_grams(
            s.first,
            s.place,
            s.time,
            s.envelope,
            s.irradiance,
            np.ascontiguousarray(series),
            levels,
            s.wave_number,
            noise,
            self.length_noise,
        )
        by_scores = self.prior.by_scores(slopes.reshape(-1, slopes.shape[-1]), scores).reshape(slopes.shape)
        drift = (self._precision(levels) * levels**2).sum()
        total = float(grams[:, -1, -1].sum() + drift + scores @ scores)
        return _State(scores, levels, noise, by_scores, grams, squares, total)

    def with_noise(self, state: _State) -> _State:
        """The same point with the noise that its residuals show."""
        if self.length_noise:
            return self.look(state.scores, state.levels, state.noise)
        left = self.samples.counts - _LEVELS - len(state.scores) / len(self.samples)
        return self.look(state.scores, state.levels, self._floor(np.sqrt(state.squares / left)))

    def descend(self, state: _State, max_steps: int) -> tuple[_State, int, bool]:
        """Damped Gauss-Newton steps with the nuisances eliminated; how many, and whether the minimum is reached."""
        damping, n = 0.0, len(state.scores)
        for taken in range(max_steps):
            rows, left, answers = self.reduced(state)
            orthonormal, triangle = linalg.qr(np.vstack([rows, np.eye(n)]), mode="economic")
            along = orthonormal.T @ np.concatenate([left, -state.scores])
            if float(along @ along) < _DECREMENT:
                return state, taken, True
            for _ in range(12):
                damped = np.vstack([triangle, np.sqrt(damping) * np.diag(np.linalg.norm(triangle, axis=0))])
                step = np.linalg.lstsq(damped, np.concatenate([along, np.zeros(n)]))[0]
                # Where the phases are far off their own full step may lead up, however short that of the parameters.
                levels = state.levels + _follow(state, answers, step) / (1.0 + damping)
                moved = self.look(state.scores + step, levels, state.noise)
                # With noise on the length the weights move too, so the total may rise by a little.
                if moved.total <= state.total * (1 + (1e-3 if self.length_noise else 1e-12)):
                    break
                damping = max(10.0 * damping, 1e-4)
            else:
                return state, taken, float(along @ along) < _STUCK
            state, damping = moved, damping / 10.0 if damping > 1e-6 else 0.0
        return state, max_steps, False

    def reduced(self, state: _State) -> tuple[Floats, Floats, Floats]:
        """Whitened rows of the scores and residuals without the nuisances, and how these answer.

        What no sweep sees is zero in the rows to the last digit; their inner products would lose it. Shapes (n_traces *
        (NODES - 1), n_free), (n_traces * (NODES - 1),), (n_traces, n_levels, NODES).
        """
        schur, pull, answers = self._eliminated(state)
        eigenvalues, vectors = np.linalg.eigh(schur)
        seen = eigenvalues > 1e-13 * eigenvalues[:, -1:]
        roots = np.sqrt(np.where(seen, eigenvalues, 0.0))
        across = vectors.transpose(0, 2, 1)
        rows = (roots[..., None] * across) @ state.slopes
        left = (across @ pull[..., None])[..., 0] * np.where(seen, 1.0 / np.where(seen, roots, 1.0), 0.0)
        return rows.reshape(-1, rows.shape[-1]), left.reshape(-1), answers

    def _eliminated(self, state: _State) -> tuple[Floats, Floats, Floats]:
        """Information on the series without the nuisances, pull of the residuals on it, answers of the nuisances."""
        n = NODES - 1
        levels, precision = state.grams[:, n:-1, n:-1].copy(), self._precision(state.levels)
        at = np.arange(levels.shape[1])
        levels[:, at, at] += precision
        mixed, own = state.grams[:, :n, n:-1], state.grams[:, :n, :n]
        left_own, left_levels = state.grams[:, :n, -1], state.grams[:, n:-1, -1] - precision * state.levels
        # One solution for all right sides: the answers to the series and to the residuals.
        answers = np.linalg.solve(levels, np.concatenate([mixed.transpose(0, 2, 1), left_levels[..., None]], axis=2))
        schur = own - mixed @ answers[..., :n]
        pull = left_own - (mixed @ answers[..., n:])[..., 0]
        return schur, pull, answers

    def _precision(self, levels: Floats) -> Floats:
        """Inverse variances of the nuisances' prior, shape of `levels`: those of slow drift, mirror light, harmonic."""
        # The first terms and the phase are free; what little they get keeps a trace without fringes solvable.
        size = np.full_like(levels, _FREE**-2.0)
        for start in (0, _DEGREE):
            size[:, start + 1 : start + _DEGREE] = (_DRIFT * self._scale[:, start // _DEGREE, None]) ** -2.0
        size[:, 2 * _DEGREE] = self._scale[:, 1] ** -2.0
        size[:, 2 * _DEGREE + 1 : -1] = (_HARMONIC * self._scale[:, 1:]) ** -2.0
        return size

    @cached_property
    def _scale(self) -> Floats:
        """Mean and half the range of each trace's irradiance, shape (n_traces, 2): what drift is relative to."""
        s = self.samples
        parts = [s.irradiance[a:b] for a, b in zip(s.first[:-1], s.first[1:], strict=True)]
        return np.array([[max(abs(float(p.mean())), 1e-12), max(float(np.ptp(p)) / 2.0, 1e-12)] for p in parts])

    def _floor(self, noise: Floats) -> Floats:
        """Noise that is not below what the converter's steps make."""
        step = self.model.cell.interferometer.step
        return np.asarray(np.maximum(noise, step / np.sqrt(12.0)))


def _follow(state: _State, answers: Floats, step: Floats) -> Floats:
    """How the nuisances follow a step of the scores, shape (n_traces, n_levels)."""
    n = NODES - 1
    return np.asarray(answers[..., n] - (answers[..., :n] @ (state.slopes @ step)[..., None])[..., 0])


def _result(
    fit: _Fit,
    state: _State,
    chosen: ParameterSet,
    index: TraceIndex,
    start: Estimate,
    steps: int,
    converged: bool,
    seconds: float,
) -> TraceFit:
    jacobian = fit.reduced(state)[0]
    spectrum = spectrum_of(jacobian)
    inverse = linalg.solve_triangular(posterior_triangle(jacobian), np.eye(len(chosen)))
    factor = fit.prior.slopes(state.scores) @ inverse
    covariance = factor @ factor.T
    status = statuses(spectrum.null_share, np.diag(covariance) / fit.prior.sd**2)
    residual = np.sqrt(state.squares / fit.samples.counts)
    warnings = []
    if not converged:
        warnings.append(f"the fit of the traces did not converge in {steps} steps: do not use this estimate")
    expected = np.hypot(fit.model.cell.interferometer.noise, _vibration(fit, state))
    off = np.flatnonzero(residual > _OFF * expected)
    if len(off):
        named = ", ".join(fit.samples.labels[i] for i in off[:5])
        more = ", ..." if len(off) > 5 else ""
        warnings.append(
            f"{len(off)} of {len(residual)} traces are met worse than {_OFF:g} times the photodiode's noise "
            f"({named}{more}): the estimate to start from was off by fringes, or the model does not hold"
        )
    values = fit.prior.values(state.scores)
    estimate = replace(
        start,
        parameters=ParameterSet(replace(p, prior_sd=float(sd)) for p, sd in zip(chosen, fit.prior.sd, strict=True)),
        values=values,
        covariance=covariance,
        status=status,
        time_h=float(index.sweeps.time_h.max()),
        valid_until_h=None,
    )
    return TraceFit(
        estimate=estimate,
        labels=fit.samples.labels,
        residual=residual,
        noise=state.noise,
        levels=state.levels,
        n_samples=int(fit.samples.first[-1]),
        rank=spectrum.rank,
        steps=steps,
        converged=converged,
        seconds=seconds,
        warnings=tuple(warnings),
    )


def _vibration(fit: _Fit, state: _State) -> Floats:
    """Volts that noise on the length makes, at the mean slope of the fringes, shape (n_traces,)."""
    slope = state.levels[:, _DEGREE] * fit.samples.wave_number / np.sqrt(2.0)
    return np.asarray(fit.length_noise * np.abs(slope))
