"""Are the stated priors as wide as the parameters lie apart? One factor per kind of parameter, by its evidence.

Around the minimum the whitened rows are y = J v + e with scores v, of which the prior says N(0, S^2), S a factor for
each kind (empirical Bayes; MacKay 1992). The evidence of S is that of y under I + J S^2 J'; a factor itself is
log-normal around 1. Where the data do not contradict the stated priors these stand to the last digit.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.minimise import Solution, minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import Reason

#: Standard deviation of a factor's logarithm, and the gain in log evidence from which on it is believed: by chance
#: stated priors that are right are contradicted in about one of a thousand fits.
_LOG_SD, _LEAST_GAIN = float(np.log(3.0)), 6.0
#: The farthest that is looked for, how often rows are linearised anew, and what is no change of a factor's logarithm.
_FARTHEST, _ROUNDS, _CLOSE = float(np.log(100.0)), 6, 0.05
#: Of an angle, in rad: a robot whose angles were thought to be as far off is wired another way.
_WIDEST = float(np.radians(10.0 + 1e-6))


def kinds(parameters: ParameterSet) -> list[tuple[str, NDArray[np.int64]]]:
    """Parameters that belong together, by name: angles and lengths of the robot, mirror, fibre."""
    blocks: dict[str, list[int]] = {}
    for i, parameter in enumerate(parameters):
        if parameter.kind == "extrinsic":
            name = "mirror on the tool" if parameter.name.endswith("_et") else "fibre in the world"
        else:
            name = {"deg": "robot angles", "um": "robot lengths", "ppm": "joint gains"}[parameter.unit]
        blocks.setdefault(name, []).append(i)
    return [(name, np.array(members, dtype=np.int64)) for name, members in blocks.items()]


def with_likely_priors(problem: Problem, solution: Solution) -> tuple[Problem, dict[str, float]]:
    """The problem under likelier priors, with factors by kind, where the data contradict independent normals."""
    if problem.prior.factor is not None or problem.prior.others or problem.considered is not None:
        return problem, {}
    stated, blocks = problem.prior, kinds(problem.model.free)
    log, angles = np.zeros(len(blocks)), np.array([p.unit == "deg" for p in problem.model.free])
    for _ in range(_ROUNDS):
        before, log = log, _likely(problem, solution.unknowns, blocks, log)
        if np.abs(log - before).max() < _CLOSE:
            break
        values, sd = problem.values(solution.unknowns), stated.sd.copy()
        for (_, members), value in zip(blocks, log, strict=True):
            sd[members] *= np.exp(value)
        if (sd[angles] > _WIDEST).any() and log.max() > 0:
            return problem, {}
        problem = replace(problem, prior=replace(stated, sd=sd))
        solution = minimise(problem, problem.unknowns(values))
    return problem, {name: float(np.exp(value)) for (name, _), value in zip(blocks, log, strict=True) if value}


def _likely(problem: Problem, at: Floats, blocks: list[tuple[str, NDArray[np.int64]]], already: Floats) -> Floats:
    """Logarithms of the factors on the stated priors, which the problem has made `already`; zero where these stand."""
    jacobian = problem.data_jacobian(at)
    seen = jacobian.T @ jacobian
    members = np.array([np.isin(np.arange(problem.n_free), each) for _, each in blocks], dtype=float)
    told, stated = jacobian.T @ (jacobian @ at - problem.data_residuals(at)), -already @ members

    def cost(log: Floats, directions: Floats) -> float:
        """Of factors, by logarithm, on parameters as `directions` (n_factors, n_free) have them."""
        sizes = np.exp(stated + log @ directions)
        inner = np.eye(problem.n_free) + sizes[:, None] * seen * sizes
        fit = (sizes * told) @ np.linalg.solve(inner, sizes * told)
        return 0.5 * (float(np.linalg.slogdet(inner)[1]) - float(fit) + float((log / _LOG_SD) @ (log / _LOG_SD)))

    def best(directions: Floats, first: Floats) -> tuple[float, Floats]:
        """Least cost, with the factors of all others at one, and the logarithms."""
        if not len(first):
            return cost(first, directions), first
        found = optimize.minimize(cost, first, args=(directions,), bounds=[(-_FARTHEST, _FARTHEST)] * len(first))
        return float(found.fun), found.x

    chosen, log = list(range(len(blocks))), np.zeros(len(blocks))
    whole, found = best(members, already)
    if cost(log, members) - whole < _LEAST_GAIN:
        return log
    # Kinds that gain too little go, the least first.
    while chosen:
        others = [[j for j in chosen if j != i] for i in chosen]
        costs = [best(members[rest], already[rest])[0] - whole for rest in others]
        if min(costs) >= _LEAST_GAIN:
            break
        chosen = others[int(np.argmin(costs))]
        whole, found = best(members[chosen], already[chosen])
    # One parameter far out is no prior of a kind that is too small, but something that the model leaves out.
    if (found > 0).any():
        alone = min(best(one[None], np.zeros(1))[0] for one in np.eye(problem.n_free))
        if alone - whole < _LEAST_GAIN:
            return log
    log[chosen] = found
    return log


def wrong_priors(factors: dict[str, float]) -> Reason:
    """What is said where the stated priors do not stand."""
    told = ", ".join(f"{name} {factor:.2g} times" for name, factor in factors.items())
    text = (
        f"the data contradict the stated priors, standard deviations by the evidence: {told} as stated; the fit takes "
        "them so: state them in the cell, or look for what moved the parameters"
    )
    return Reason("priors", text)
