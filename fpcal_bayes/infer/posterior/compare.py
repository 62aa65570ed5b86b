"""Which model do the data favour? Fits and leave-one-out predictions of several, and a verdict in words.

A model that does not fit, or that cannot be sampled, does not end the comparison: it is said.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal, get_args

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import chi2_tail
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.posterior.draws import Likelihood, charted_draws, misfit_of
from fpcal_bayes.infer.posterior.leave_out import LeaveOneOut, leave_one_out, left_out_each, standard_error
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.beams import Opd
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.error_motions import TERMS
from fpcal_bayes.model.trust import POOR_FIT_BELOW, Trust

State = Literal["sampled", "no minimum", "not sampled"]

#: Least difference that leave-one-out resolves (Sivula et al. 2020), and how many of its standard errors it must be.
LEAST_DIFFERENCE, LEAST_ERRORS = 4.0, 2.0
#: A model that its own fit rejects is sampled as far as a sentence on it needs.
_POOR_DRAWS, _POOR_REFITS = 400, 40
_MOST_REFITS = 200

_PATH_WORDS: dict[Opd, str] = {
    "axis": "the axis path",
    "perpendicular": "the perpendicular path",
    "distance": "the distance to the point",
}
_LIKELIHOOD_WORDS = {"gaussian": "", "student": " with Student-t noise", "slip": " with fringe slips"}


@dataclass(frozen=True)
class ModelSpec:
    """What a model is."""

    name: str  # as the user wrote it
    opd: Opd  # path model
    likelihood: Likelihood
    mechanics: str = "stated"  # of the cell: ``stated``, ``none``, or ``no-`` with a term that is left out

    @property
    def words(self) -> str:
        """The model in a sentence."""
        mechanics = {"stated": "", "none": " on a perfect mechanism"}
        left_out = f" without {self.mechanics.removeprefix('no-')}"
        return _PATH_WORDS[self.opd] + _LIKELIHOOD_WORDS[self.likelihood] + mechanics.get(self.mechanics, left_out)

    def cell(self, cell: Cell) -> Cell:
        """The cell as the model takes it."""
        cell = cell.with_opd(self.opd)
        if cell.mechanics is None or self.mechanics == "stated":
            return cell
        if self.mechanics == "none":
            return cell.ideal
        return replace(cell, mechanics=cell.mechanics.without(self.mechanics.removeprefix("no-")))


def parse_models(text: str, cell: Cell) -> list[ModelSpec]:
    """Parse models like ``opd=axis,opd=perpendicular+likelihood=slip``; what is not set is the cell's, and Gaussian."""
    allowed = {
        "opd": ("axis", "perpendicular"),
        "likelihood": get_args(Likelihood),
        "mechanics": ("stated", "none", *(f"no-{term}" for term in TERMS)),
    }
    models: list[ModelSpec] = []
    for name in text.split(","):
        settings: dict[str, Any] = {"opd": cell.opd, "likelihood": "gaussian", "mechanics": "stated"}
        for setting in name.strip().split("+"):
            key, _, value = setting.partition("=")
            expected = "opd=..., likelihood=... or mechanics=..."
            if value not in allowed.get(key, ()):
                expected = f"{key} {' or '.join(allowed[key])}" if key in allowed else expected
                found = value if key in allowed else setting
                raise InputError(f"--models {name!r:.60}: expected {expected}, found {found!r:.60}")
            settings[key] = value
        if settings["mechanics"] != "stated" and cell.mechanics is None:
            raise InputError(f"--models {name!r:.60}: the cell states no mechanics or --mechanics none leaves them out")
        models.append(ModelSpec(name.strip(), **settings))
    if len(models) < 2:
        raise InputError(f"--models {text!r:.60}: expected at least two models, with commas between them")
    for other, model in combinations(models, 2):
        if replace(model, name="") == replace(other, name=""):
            raise InputError(f"--models: {other.name!r:.60} and {model.name!r:.60} are the same model")
    return models


@dataclass(frozen=True)
class ModelResult:
    """What is known of one model."""

    spec: ModelSpec
    identification: Identification  # its fit
    loo: LeaveOneOut | None  # predictions, or None if it was not sampled
    failures: tuple[str, ...] = ()  # why it was not
    misfit: str | None = None  # what a likelihood that is not Gaussian says itself against the rows

    @property
    def state(self) -> State:
        """How far the model came."""
        if self.loo is not None:
            return "sampled"
        return "not sampled" if self.identification.converged else "no minimum"

    @property
    def poor(self) -> bool:
        """Whether the model is rejected by its own chi-square, or by its own posterior predictive check."""
        if self.spec.likelihood != "gaussian":
            return self.misfit is not None
        fit = self.identification
        return min(fit.fit.p_value, chi2_tail(fit.solution.sum_of_squares, len(fit.problem.target))) < POOR_FIT_BELOW

    @property
    def fits(self) -> bool:
        """Whether the model has a fit that its own chi-square allows."""
        return self.identification.converged and not self.poor

    def sentence(self) -> str | None:
        """What is wrong with the model by itself, or None."""
        fit = self.identification.fit
        size = f"chi-square {fit.chi2_data:,.0f} where {fit.expected:.0f} is expected"
        if self.state == "no minimum":
            starts = f"no minimum was found from {self.identification.starts} starting points"
            return f"{self.spec.words} does not fit: {starts} ({size})"
        if self.misfit is not None:
            return f"{self.spec.words}: {self.misfit}"
        unsampled = f"its posterior could not be sampled ({'; '.join(self.failures)})" if self.failures else ""
        if self.poor:
            also = f"; {unsampled}" if unsampled else ""
            return f"{self.spec.words} does not fit: {size}; it is rejected by its own fit{also}"
        return f"{self.spec.words} is not compared: {unsampled}" if unsampled else None

    def content(self) -> dict[str, Any]:
        """What ``compare --json`` writes of the model."""
        fit, loo = self.identification.fit, self.loo
        told: dict[str, Any] = dict.fromkeys(("elpd", "se", "p_loo", "bad_k", "refitted", "max_k"))
        if loo is not None:
            counts = int(loo.bad.sum()), int(loo.refitted.sum())
            most = float(loo.pareto_k.max()) if np.isfinite(loo.pareto_k).all() else None
            told = dict(zip(told, (loo.elpd, loo.se, loo.p_loo, *counts, most), strict=True))
        return {
            "name": self.spec.name,
            "opd": self.spec.opd,
            "likelihood": self.spec.likelihood,
            "state": self.state,
            **told,
            "chi2_data": fit.chi2_data,
            "chi2_expected": fit.expected,
            "p_value": fit.p_value,
            "fits": self.fits,
            "converged": self.identification.converged and not self.failures,
        }


@dataclass(frozen=True)
class Difference:
    """How much better one model predicts than another."""

    better: ModelSpec
    worse: ModelSpec
    elpd: float  # sum over the rows of the difference of their log densities
    se: float  # its standard error
    at_least: bool  # whether `elpd` is a lower bound, since rows of the worse model could not be left out
    rejected: bool = False  # whether only the better one fits: a few rows may then make up the difference and its se

    @property
    def clear(self) -> bool:
        """Whether the data tell the two apart."""
        return self.elpd >= LEAST_DIFFERENCE and (self.rejected or self.elpd > LEAST_ERRORS * self.se)

    def sentence(self) -> str:
        """The difference in words."""
        size = f"{self.elpd:,.{0 if self.elpd >= 10 else 1}f} +- {self.se:,.{0 if self.se >= 10 else 1}f}"
        if not self.clear:
            return f"{self.better.words} and {self.worse.words} cannot be told apart (difference {size})"
        bound = "at least " if self.at_least else ""
        return f"the data favour {self.better.words} by {bound}{size} over {self.worse.words}"

    def content(self) -> dict[str, Any]:
        """What ``compare --json`` writes of the difference."""
        names = {"better": self.better.name, "worse": self.worse.name}
        return names | {name: getattr(self, name) for name in ("elpd", "se", "clear", "at_least")}


@dataclass(frozen=True)
class Comparison:
    """Result of `compare`."""

    models: tuple[ModelResult, ...]  # in the order asked for
    differences: tuple[Difference, ...]  # of the best model to every other one that was sampled, closest first

    @property
    def sound(self) -> bool:
        """Whether at least one model was sampled."""
        return any(model.loo is not None for model in self.models)

    @property
    def verdict(self) -> str:
        """The result in words."""
        said = [*(difference.sentence() for difference in self.differences), *self._against()]
        if not self.sound:
            return "; ".join(said)
        if not any(model.fits for model in self.models):
            said.append("none of the models fits")
        elif not self.differences:
            left = next(model for model in self.models if model.loo is not None)
            said.insert(0, f"the data favour {left.spec.words}, the only model that could be sampled")
        return "; ".join(said)

    def _against(self) -> list[str]:
        said = [s for s in (model.sentence() for model in self.models) if s is not None]
        return said if self.sound else [*said, "no model could be sampled: nothing can be compared"]

    @property
    def trust(self) -> Trust:
        """What is held against the model that is favoured, or against all where none fits."""
        if any(model.fits for model in self.models):
            return Trust()
        return Trust().because(*(r for model in self.models for r in model.identification.estimate.trust.reasons))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about what is not to be trusted."""
        said = self._against()
        for model in self.models:
            left = 0 if model.loo is None else int(model.loo.open.sum())
            if left:
                said.append(
                    f"{model.spec.name}: {left} rows with a Pareto k too large for importance sampling were not left "
                    "out in earnest; their elpd is an upper bound"
                )
            sweeps = model.identification.problem.sweeps
            if not (sweeps.signed | sweeps.absolute | (sweeps.group == "")).all():
                said.append(
                    f"{model.spec.name}: rows of unknown sign that share a reading take the sign that fits best"
                )
        return tuple(said)

    def content(self) -> dict[str, Any]:
        """What ``compare --json`` writes, without schema and command."""
        return {
            "models": [model.content() for model in self.models],
            "difference": self.differences[0].content() if self.differences else None,
            "differences": [difference.content() for difference in self.differences],
            "verdict": self.verdict,
            "warnings": list(self.warnings),
        }


def compare(
    cell: Cell,
    sweeps: Sweeps,
    specs: Sequence[ModelSpec],
    *,
    draws: int = 2000,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Fit and sample each model, `draws` effective draws, and compare; `InputError` if the sweeps do not allow it."""
    fits: dict[tuple[str, str], Identification] = {}
    models = []
    for spec in specs:
        if progress is not None:
            progress(f"sampling {spec.words}")
        key = (spec.opd, spec.mechanics)
        if key not in fits:
            fits[key] = identify(spec.cell(cell), sweeps)
        models.append(_sampled(ModelResult(spec, fits[key], None), draws, seed))
    return Comparison(tuple(models), _differences(models))


def _sampled(model: ModelResult, draws: int, seed: int) -> ModelResult:
    if not model.identification.converged:
        return model
    likelihood, problem = model.spec.likelihood, model.identification.problem
    asked = f"{problem.sweeps.file}: {model.spec.name!r:.60}"
    if likelihood != "gaussian" and model.identification.machine is not None:
        raise InputError(f"{asked}: with mechanics the rows are Gaussian")
    if likelihood != "gaussian" and problem.whitening.batches:
        raise InputError(f"{asked} needs rows without a group, found rows that share a reading")
    draws, refits = (min(draws, _POOR_DRAWS), _POOR_REFITS) if model.poor else (draws, _MOST_REFITS)
    # Rows are left out at the scales that the mechanics have with all of them.
    random = np.random.default_rng(seed)
    known = charted_draws(model.identification, likelihood, draws, random)
    if known is not None:
        if likelihood != "gaussian":
            p = known.target.predictive_p(known.equal(draws, random), random)
            model = replace(model, misfit=misfit_of(known.target, p))
        return replace(model, loo=left_out_each(model.identification, known, likelihood, most_refits=refits, seed=seed))
    if model.poor:
        return replace(model, failures=("too few draws of it can be made",))
    posterior = sample(model.identification, draws=draws, likelihood=likelihood, scales_held=True, seed=seed)
    if not posterior.converged:
        return replace(model, failures=posterior.failures)
    model = replace(model, misfit=posterior.misfit)
    return replace(model, loo=leave_one_out(posterior, likelihood, most_refits=refits, seed=seed))


def _differences(models: Sequence[ModelResult]) -> tuple[Difference, ...]:
    """Differences of the best sampled model to the others; a model that fits comes before one that does not."""
    ranked = sorted(
        ((model, model.loo) for model in models if model.loo is not None), key=lambda m: (not m[0].fits, -m[1].elpd)
    )
    if not ranked:
        return ()
    best, best_loo = ranked[0]
    return tuple(
        Difference(
            better=best.spec,
            worse=model.spec,
            elpd=best_loo.elpd - loo.elpd,
            se=standard_error(best_loo.elpd_rows - loo.elpd_rows),
            at_least=bool(loo.open.any()),
            rejected=best.fits and model.poor,
        )
        for model, loo in ranked[1:]
    )
