"""Identify a cell from sweeps: the maximum of the posterior, its covariance, and how far to trust them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import chance, chi2_tail, counted
from fpcal_bayes.core.notebook import Result
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.fit.minimise import (
    DECREMENT_TOLERANCE,
    Solution,
    curve_sd,
    distinct_minima,
    minimise,
    sign_images,
    solution_rank,
    spread_over,
)
from fpcal_bayes.infer.fit.mistakes import axis_rivals, second_solution
from fpcal_bayes.infer.fit.prior import BENT, Prior, bends
from fpcal_bayes.infer.fit.prior_sizes import with_likely_priors, wrong_priors
from fpcal_bayes.infer.fit.problem import Problem, held_reasons, hold_rest
from fpcal_bayes.infer.fit.signs import DOUBTFUL, SignDecision, decide_signs
from fpcal_bayes.infer.fit.slips import slip_reasons
from fpcal_bayes.infer.fit.spectrum import GoodnessOfFit, Spectrum, Status, goodness_of_fit, spectrum_of, statuses
from fpcal_bayes.infer.mechanics.fit import MechanicsFit, fit_mechanics, many_rows, thinned
from fpcal_bayes.infer.mechanics.judge import doubts_of
from fpcal_bayes.infer.mechanics.known import covariance_of, knowledge_of_fit
from fpcal_bayes.io.sweeps import packed
from fpcal_bayes.measure.sweeps import Sweeps, repeated_rows
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import LEAST_EXPECTED, FitEvidence, Reason, judge_fit

Hold = Literal["consider", "exact"]

#: Below this probability of a sum of squares as large as the one found, other starts are tried.
RETRY_BELOW = 1e-3
_RELINEARISATIONS = 100


@dataclass(frozen=True)
class Identification(Result):
    """Result of `identify`."""

    estimate: Estimate  # maximum of the posterior with its Laplace covariance
    problem: Problem  # the least-squares problem as it was solved last
    solution: Solution  # its minimum
    free: ParameterSet  # the parameters that were identified
    spectrum: Spectrum  # what the data tell about them
    fit: GoodnessOfFit  # how well the data are met
    other_minima: tuple[Solution, ...]  # further ones that count for the posterior, lowest first
    signs: SignDecision | None  # how the unsigned rows were decided, or None
    starts: int  # number of starting points that were tried
    seconds: float  # time of the identification itself
    warnings: tuple[str, ...]  # sentences about what is not to be trusted
    machine: MechanicsFit | None = None  # the fit with the cell's mechanics marginalised, or None: a perfect mechanism

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        return (
            f"Identification({state}, {len(self.problem.sweeps)} rows, rank {self.spectrum.rank} of {len(self.free)}, "
            f"{chance(self.fit.p_value)})"
        )

    @property
    def converged(self) -> bool:
        """Whether the minimum was reached."""
        return self.solution.converged

    @property
    def own(self) -> Ints:
        """Positions of the identified parameters among the free ones of the problem, shape (n,)."""
        return self.problem.model.free.positions(self.free.names)

    @property
    def doubtful_signs(self) -> list[tuple[str, float]]:
        """Labels of the rows whose sign may be the other one, with that probability, likeliest first."""
        return _doubtful(self.problem.sweeps, self.signs)

    @property
    def undetermined(self) -> list[str]:
        """Names of the free parameters along which the estimate is the prior."""
        status = dict(zip(self.estimate.parameters.names, self.estimate.status, strict=True))
        return [name for name in self.free.names if status[name] == "gauge"]

    def largest_residuals(self, n: int = 5) -> list[tuple[str, float]]:
        """Labels of the rows with the largest standardised residuals, largest first."""
        return self.fit.largest(self.problem.sweeps.names, n)

    def content(self) -> dict[str, Any]:
        """What ``identify --json`` writes, without schema and command."""
        return {
            **self.estimate.content(),
            "fit": {
                "sum_of_squares": self.solution.sum_of_squares,
                "chi2_data": self.fit.chi2_data,
                "chi2_expected": self.fit.expected,
                "p_value": self.fit.p_value,
                "n_sweeps": len(self.problem.sweeps),
                "rank": self.spectrum.rank,
                "undetermined": self.undetermined,
                "converged": self.converged,
                "starts": self.starts,
                "seconds": self.seconds,
            },
            "residuals": [{"label": label, "standardised": value} for label, value in self.largest_residuals()],
            "doubtful_signs": [{"label": label, "probability": p} for label, p in self.doubtful_signs],
            "rows": packed(self.problem.sweeps, self.estimate.cell),
            "warnings": list(self.warnings),
        }


def identify(
    cell: Cell,
    sweeps: Sweeps,
    *,
    free: str | Sequence[str] = "all",
    start: Estimate | None = None,
    hold: Hold = "consider",
    prior: Estimate | None = None,
    seed: int = 0,
    max_starts: int = 10,
) -> Identification:
    """Identify the free parameters of a cell by Levenberg-Marquardt.

    Parameters
    ----------
    cell
        The cell with its priors and its path model.
    sweeps
        The sweeps of one session, measured.
    free
        ``all``, ``intrinsic``, ``extrinsic`` or parameter names; the others are held at `start` (nominal without).
    start
        An earlier estimate: starting point of the free parameters, value and covariance of the held ones.
    hold
        ``consider``: held parameters are uncertain by the covariance of `start` (the prior without one) and that
        uncertainty reaches the result (Schmidt's consider parameters). ``exact``: they are taken as known.
    prior
        Values and covariance, jointly normal, that are the prior of the free parameters in it; by default the priors of
        the cell. What earlier sweeps said is not normal: `pool` takes the sweeps themselves.
    seed
        Seed of the further starting points, drawn from the prior, that are tried when the first leads to a poor fit.
    max_starts
        How many starting points to try at most.

    Raises
    ------
    InputError
        If a parameter name is unknown, nothing is free, or the sweeps carry no measurement.
    """
    began = time.perf_counter()
    warnings: list[str] = []
    used = sweeps.take(sweeps.kind != "path") if (sweeps.kind == "path").any() else sweeps
    if len(used) < len(sweeps):
        warnings.append(f"{counted(len(sweeps) - len(used), 'row')} of kind path not used in the identification")
    if len(used) == 0 or not used.measured:
        raise InputError(f"{sweeps.file}: expected at least one sweep with dl_um and sigma_um")
    chosen = cell.select(free)
    if not len(chosen):
        raise InputError("nothing is free: expected at least one parameter to identify")
    model, considered = hold_rest(cell, chosen, start, hold)
    before = None if prior is None else Prior.joint(model.free, prior)
    problem = Problem.of(model, used, considered, prior=before, linearised=not many_rows(cell, used))
    first = _starting_unknowns(problem, start)

    signs: SignDecision | None = None
    if not (used.signed | used.absolute).all():
        signs = decide_signs(problem, first)
        if problem.depends_on_point:
            signs = decide_signs(problem.relinearised(signs.solution.unknowns), signs.solution.unknowns)
        problem, first = problem.with_target(signs.target), signs.solution.unknowns
        if not signs.complete:
            warnings.append("the search for the unknown signs was ended at its limit: other signs may fit better")
    whole, problem = problem, thinned(problem)
    doubts: list[Reason] = []
    rng = np.random.default_rng(seed)
    problem, solution, found, starts = _fit(problem, first, rng, max_starts)
    likely, factors = with_likely_priors(problem, solution)
    if factors:
        again = _fit(likely, likely.unknowns(problem.values(solution.unknowns)), rng, max_starts)
        if chi2_tail(again[1].sum_of_squares, len(used)) >= RETRY_BELOW:
            signs = None if signs is None else signs.rescaled(problem.prior.sd / likely.prior.sd)
            (problem, solution, found, starts), doubts = again, [wrong_priors(factors)]
    others = distinct_minima(problem, solution, found)
    rival = second_solution(model.free.names, solution, others)
    machine, lost = None, None
    if cell.mechanics is not None:
        many = len(whole.target) > len(problem.target)
        if many and whole.considered is not None:
            whole = whole.relinearised(solution.unknowns)
        try:
            machine = fit_mechanics(whole if many else problem, cell.mechanics, start=solution.unknowns, seed=seed)
        except np.linalg.LinAlgError:
            lost = replace(solution, converged=False)
        else:
            problem, solution = machine.problem, machine.solution
            doubts += doubts_of(machine)
        if many and machine is not None:
            # Second solutions of the thinned rows, as all rows see them.
            others = distinct_minima(problem, solution, [minimise(problem, other.unknowns) for other in others])
            rival = second_solution(model.free.names, solution, others)
    solution = lost or solution
    unknowns, own = solution.unknowns, model.free.positions(chosen.names)
    spectrum = spectrum_of(problem.prior_scaled_jacobian(unknowns)[:, own])
    covariance = problem.covariance(unknowns) if machine is None else covariance_of(machine)
    told: list[Solution] = []
    if signs is not None and machine is None and len(whole.target) == len(problem.target):
        # Error motions are fitted with one choice of signs; priors may have changed since others were weighed.
        since = solution.sum_of_squares - signs.solution.sum_of_squares
        told = [replace(each, sum_of_squares=each.sum_of_squares + since) for each in signs.rivals]
    covariance = spread_over(problem, covariance, solution, [*others, *told])
    status = statuses(spectrum.null_share, np.diag(covariance)[own] / problem.prior.sd[own] ** 2)
    by_name = dict(zip(chosen.names, status, strict=True))
    noise_only = fit = goodness_of_fit(problem, unknowns)
    if machine is not None:
        # A machine that is better than its sheet leaves the rows closer to the fit than expected; not so the readings.
        ideal = replace(problem, model=replace(problem.model, cell=cell.ideal), log_scales=None)
        noise_only = goodness_of_fit(ideal.relinearised(unknowns), unknowns)

    evidence = FitEvidence(
        converged=solution.converged,
        starts=starts,
        n_rows=len(used),
        chi2_data=fit.chi2_data,
        expected=fit.expected,
        p_value=fit.p_value,
        sum_of_squares=solution.sum_of_squares,
        p_total=chi2_tail(solution.sum_of_squares, len(used)),
        rank=spectrum.rank,
        worst=", ".join(f"{label} {size:+.3g} sd" for label, size in fit.largest(used.names, 3)),
        chi2_noise=noise_only.chi2_data,
        # Of the light of whole traces more is allowed for than most light does: they may lie closer to the fit.
        expected_noise=0.0 if used.common.any() else noise_only.expected,
        p_noise=noise_only.p_value,
    )
    trust = judge_fit(
        evidence, *rival, *_doubt(used, signs), *held_reasons(problem, unknowns, exact=hold == "exact"), *doubts
    )
    if trust.usable and fit.expected > LEAST_EXPECTED:
        trust = trust.because(*axis_rivals(problem, solution))
    if {"not-converged", "poor-fit", "mechanics", "residuals"} & {reason.kind for reason in trust.reasons}:
        trust = trust.because(*slip_reasons(problem, solution))
    warnings += trust.texts
    # What is held, or stood in as prior, is trusted no more than where it came from.
    leaned_on = [known for known in (prior, None if len(chosen) == len(cell.free) else start) if known is not None]
    trust = trust.because(*(reason for known in leaned_on for reason in known.trust.reasons))
    if prior is not None and bends(prior):
        trust = trust.because(Reason("bent-prior", BENT))
        warnings.append(BENT)
    estimate = replace(_estimate(cell, used, problem, covariance, by_name, unknowns), trust=trust)
    if machine is not None:
        estimate = replace(estimate, mechanics=knowledge_of_fit(machine, estimate.parameters, chosen.names))
    return Identification(
        estimate=estimate,
        problem=problem,
        solution=solution,
        free=chosen,
        spectrum=spectrum,
        fit=fit,
        other_minima=others,
        signs=signs,
        starts=starts,
        seconds=time.perf_counter() - began,
        warnings=tuple(warnings),
        machine=machine,
    )


def _starting_unknowns(problem: Problem, start: Estimate | None) -> Floats:
    """Scaled unknowns (n_unknowns,) of `start`, or the middle of the prior."""
    if start is None:
        return np.zeros(problem.n_unknowns)
    values, free = problem.values(np.zeros(problem.n_unknowns)), problem.model.free
    known = [name for name in free.names if name in start.parameters]
    values[free.positions(known)] = start.block(known)[0]
    return problem.unknowns(values)


def _converge(problem: Problem, start: Floats) -> tuple[Problem, Solution]:
    """Minimise, with the measurement covariance and the considered rows taken at the minimum itself."""
    solution = minimise(problem, start)
    if not problem.depends_on_point:
        return problem, solution
    if problem.model.cell.mechanics is not None:
        # The scales are still to be found: once is enough here.
        problem = problem.relinearised(solution.unknowns)
        return problem, minimise(problem, solution.unknowns)
    for _ in range(_RELINEARISATIONS):
        problem = problem.relinearised(solution.unknowns)
        before = problem.residuals(solution.unknowns)
        solution = minimise(problem, solution.unknowns)
        # The new weights no longer move the minimum.
        excess = float(before @ before) - solution.sum_of_squares
        if excess < DECREMENT_TOLERANCE * max(1.0, solution.sum_of_squares / len(problem.sweeps)):
            return problem, solution
    return problem, Solution(solution.unknowns, solution.sum_of_squares, converged=False)


def _fit(
    problem: Problem, first: Floats, rng: np.random.Generator, max_starts: int
) -> tuple[Problem, Solution, list[Solution], int]:
    """Lowest minimum from `first`, its images, and prior draws while the fit is poor; all minima, number of starts."""
    problem, solution = _converge(problem, first)
    found = [solution]
    found += [minimise(problem, image) for image in sign_images(problem, solution)[: max_starts - 1]]
    best = min(found, key=solution_rank)
    while len(found) < max_starts and (
        not best.converged or chi2_tail(best.sum_of_squares, len(problem.sweeps)) < RETRY_BELOW
    ):
        start = np.zeros(problem.n_unknowns)
        start[: problem.n_free] = rng.standard_normal(problem.n_free)
        found.append(minimise(problem, start))
        best = min(found, key=solution_rank)
    if best is not solution and problem.depends_on_point:
        moved, better = _converge(problem, best.unknowns)
        # Each minimum has its own linearisation; what counts is where the iteration ends.
        if solution_rank(better) < solution_rank(solution):
            problem, best = moved, better
        else:
            best = solution
    return problem, best, found, len(found)


def _doubt(used: Sweeps, signs: SignDecision | None) -> list[Reason]:
    found, doubtful, again = [], _doubtful(used, signs), repeated_rows(used)
    if doubtful:
        named = ", ".join(f"{label} ({100 * p:.0f} %)" for label, p in doubtful[:5])
        more = ", ..." if len(doubtful) > 5 else ""
        text = f"the sign of {counted(len(doubtful), 'sweep')} is doubtful (probability of the other): {named}{more}"
        found.append(Reason("signs", text))
    if again.any():
        named = ", ".join(map(str, used.rows[again][:5]))
        text = f"{again.sum()} rows stand twice, to the last digit ({named} ...): they count twice; delete the copies"
        found.append(Reason("duplicates", text))
    return found


def _estimate(
    cell: Cell, sweeps: Sweeps, problem: Problem, covariance: Floats, status: dict[str, Status], unknowns: Floats
) -> Estimate:
    """Free parameters by `status`, uncertain ones that are held, and those held as exact, in the cell's order."""
    free = problem.model.free
    uncertain = list(free.names) + list(problem.considered.parameters.names if problem.considered else ())
    # What only its prior tells of stays there, as uncertain as before; the data move what is free.
    loose = np.array([i for i, name in enumerate(free.names) if name not in status], dtype=np.int64)
    vector = problem.model.vector(problem.values(unknowns))
    vector[free.slots[loose]] = free.nominal[loose]
    covariance[np.ix_(loose, loose)] = np.diag(free.prior_sd[loose] ** 2)
    prior_sd = dict(zip(free.names, problem.prior.sd.tolist(), strict=True))
    parameters = ParameterSet(
        replace(p, prior_sd=prior_sd.get(p.name, p.prior_sd))
        for p in cell.parameters
        if p.name in uncertain or p.name in cell.free or vector[p.slot] != p.nominal
    )
    at = parameters.positions(uncertain)
    full = np.zeros((len(parameters), len(parameters)))
    full[np.ix_(at, at)] = covariance
    curve, bent = np.zeros(len(parameters)), curve_sd(problem, unknowns, covariance)
    curve[parameters.positions(np.delete(free.names, loose))] = np.delete(bent, loose)
    return Estimate(
        cell=cell,
        parameters=parameters,
        values=vector[parameters.slots],
        covariance=full,
        curve=curve,
        status=tuple(status.get(name, "fixed") for name in parameters.names),
        time_h=float(sweeps.time_h.max()),
    )


def _doubtful(sweeps: Sweeps, signs: SignDecision | None) -> list[tuple[str, float]]:
    if signs is None:
        return []
    rows = [int(i) for i in np.argsort(-signs.doubt, kind="stable") if signs.doubt[i] > DOUBTFUL]
    return [(sweeps.names[i], float(signs.doubt[i])) for i in rows]
