"""Does the fit with its mechanics explain the rows? What shows in the residuals, by the name of the term.

A fit whose scales have absorbed an error is not good because its chi-square is. Score tests ask whether the rows hold
more of a term than the fit allows: with t the rows whitened under geometry, mechanics and noise together, and X the
columns of the term whitened alike, |X't|^2 has the mean |X|^2 and the variance 2 |X'X|^2; a scaled chi-square with the
same two stands for its distribution (Satterthwaite 1946).
"""

from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy import special

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.mechanics.marginal import MarginalWhitening
from fpcal_bayes.infer.mechanics.scales import LOG_SD_NOISE
from fpcal_bayes.model.mechanics import group_of
from fpcal_bayes.model.mechanics.response import Responses, responses
from fpcal_bayes.model.mechanics.terms import HARMONICS, LEGENDRE
from fpcal_bayes.model.trust import Reason

#: Family-wise probability of naming a term that is not there.
_LEVEL = 0.01
#: A scale whose 95 % interval lies wholly above this factor on its sheet has absorbed something else.
_BEYOND = 3.0
#: Above this one no machine is so far off its sheet: the rows hold a mistake.
_ABSURD = 30.0
#: Orders that the fit leaves out, looked for in the residuals.
_POLYNOMIALS, _HARMONICS = range(LEGENDRE + 1, LEGENDRE + 6), range(HARMONICS + 1, 2 * HARMONICS + 1)


def whitened_residuals(fit: MechanicsFit) -> tuple[Floats, MarginalWhitening]:
    """Rows whitened under geometry, mechanics and noise together, shape (n_rows,), and the map that did it."""
    problem, unknowns = fit.problem, fit.solution.unknowns
    predicted, jacobian = problem.model.predict_with_jacobian(problem.values(unknowns), problem.rows)
    geometry = problem.prior.by_scores(jacobian, unknowns[: problem.n_free])
    target = problem.target - predicted + geometry @ unknowns[: problem.n_free]
    factors = np.exp(fit.scales.log.mean(axis=0))
    base = fit.noise.whitening(float(factors[-1]), float(factors[-2]))
    whitening = MarginalWhitening.around(base, np.hstack([geometry, fit.design.matrix * factors[fit.design.scale]]))
    return whitening.apply(target), whitening


def term_tests(fit: MechanicsFit) -> list[tuple[str, float]]:
    """Terms of which the rows hold more than the fit allows, likeliest first: name, probability of that by chance."""
    white, whitening = whitened_residuals(fit)
    tests = [(name, _p_value(white, whitening.apply(columns))) for name, columns in _alternatives(fit)]
    n = len(white)
    if n > 2:
        along = abs(float(white[1:] @ white[:-1])) / np.sqrt(n - 1.0)
        tests.append(("order of the rows", float(special.erfc(along / np.sqrt(2.0)))))
    tests.append(("noise beyond all terms", float(special.gammaincc(n / 2.0, float(white @ white) / 2.0))))
    return sorted(tests, key=lambda test: test[1])


def terms_content(fit: MechanicsFit) -> dict[str, Any]:
    """Scales and tests as JSON: what the rows say of the stated sizes, and which terms the residuals show."""
    low, middle, high = fit.scales.quantiles()
    return {
        "scales": {
            name: {"median": float(middle[i]), "low": float(low[i]), "high": float(high[i]), "share": 0.95}
            for i, name in enumerate(fit.scales.names)
        },
        "tests": [{"term": name, "p_value": p} for name, p in term_tests(fit)],
    }


def doubts_of(fit: MechanicsFit) -> tuple[Reason, ...]:
    """Reasons not to trust the fit, none where it explains the rows within its sheet."""
    found = []
    low, middle, high = fit.scales.quantiles()
    for name, lower, median, upper in zip(fit.scales.names, low, middle, high, strict=True):
        text = f"{name}: the rows show {median:.2g} times the stated size (95 %: {lower:.2g} to {upper:.2g})"
        if lower > _ABSURD:
            found.append(Reason("poor-fit", f"poor fit: {text}; fpcal doctor tries what may be wrong"))
        elif lower > _BEYOND and (name != "return" or _white_beyond(fit)):
            found.append(Reason("mechanics", f"{text}; fpcal doctor says what to do"))
    tests = term_tests(fit)
    found += [
        Reason(
            "residuals", f"{name}: the residuals show more than is stated (p = {p:.1g}); fpcal doctor says what to do"
        )
        for name, p in tests
        if p < _LEVEL / len(tests)
    ]
    return tuple(found)


def _white_beyond(fit: MechanicsFit) -> bool:
    """Whether the rows' own errors lie beyond what readings and return, which takes their excess, may be together."""
    returned = fit.design.matrix[:, fit.design.scale == fit.terms.scales.index("return")]
    parts = (returned, fit.design.returned, fit.design.reached_start, fit.design.reached_end)
    sizes = sum(float((part**2).sum()) for part in parts) / len(returned)
    noise = float((fit.noise.sigma**2 + (fit.noise.stated**2).sum(axis=1)).mean())
    found = np.exp(2.0 * fit.scales.log[:, -2:]) @ [sizes, noise]
    return bool(np.quantile(found, 0.025) > _BEYOND**2 * sizes + np.exp(2.0 * LOG_SD_NOISE) * noise)


def _p_value(white: Floats, columns: Floats) -> float:
    gram = columns.T @ columns
    mean, variance = float(np.trace(gram)), 2.0 * float((gram**2).sum())
    if mean <= 0.0:
        return 1.0
    statistic = float(((columns.T @ white) ** 2).sum())
    dof = 2.0 * mean**2 / variance
    return float(special.gammaincc(dof / 2.0, statistic * dof / mean / 2.0))


def _alternatives(fit: MechanicsFit) -> list[tuple[str, Floats]]:
    """Columns of terms that the fit does not hold, by name."""
    cell, drive = fit.terms.cell, fit.drive
    vector = fit.problem.model.vector(fit.values)
    beam = cell.beam_numbers(drive.beam)
    end = responses(cell, vector, fit.terms.told, drive.q_end, beam)
    start = responses(cell, vector, fit.terms.told, drive.q_start, beam)
    begun = (~drive.absolute).astype(float)[:, None]
    found = []
    for i in range(len(cell.joints)):
        if not drive.moved[:, i].any():
            continue
        along = int(fit.terms.told.along_beam[i])

        def of(q: Floats, at: Responses, i: int = i, along: int = along) -> Floats:
            return np.asarray(_beyond(fit, q[:, i], i) * at.motion[:, i, along, None])

        found.append((f"function of q{i + 1}", of(drive.q_end, end) - begun * of(drive.q_start, start)))
        sided = end.drive[:, i] * drive.end_side[:, i] - begun[:, 0] * start.drive[:, i] * drive.start_side[:, i]
        found.append((f"direction of approach of q{i + 1}", sided[:, None]))
    return found


def _beyond(fit: MechanicsFit, q: Floats, joint: int) -> Floats:
    """Basis functions of the next higher orders."""
    cell = fit.terms.cell
    if group_of(cell, joint) == "rotary":
        return np.concatenate([[np.cos(k * q), np.sin(k * q)] for k in _HARMONICS]).T
    x = (2.0 * q - cell.low[joint] - cell.high[joint]) / (cell.high[joint] - cell.low[joint])
    return np.asarray(legendre.legvander(x, max(_POLYNOMIALS))[:, list(_POLYNOMIALS)])
