"""May a result be used? One rule, which an estimate carries and every file that holds a result repeats."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from fpcal_bayes.core.linalg import chance, plain

#: Fits whose data, or data and prior, are met with a smaller probability are poor.
POOR_FIT_BELOW = 1e-3

#: With fewer rows than this beyond those that the parameters absorb, no fit is too good or as good as another.
LEAST_EXPECTED = 5.0

Verdict = Literal["usable", "doubtful", "unusable"]

_FORBID = (
    *("not-converged", "poor-fit", "intrinsics-moved", "problem"),
    *("bent-prior", "held-uncertain", "omitted", "stale"),
)
_WARN = (
    *("held-exact", "drift", "too-good-fit", "second-solution", "signs", "slips", "duplicates", "nothing-determined"),
    *("mechanics", "residuals", "verification", "priors", "mechanics-left-out", "unrecorded"),
)
#: What can be held against a result, and whether it forbids the use of it. The others are said and leave it usable.
KINDS = dict.fromkeys(_FORBID, True) | dict.fromkeys(_WARN, False)


@dataclass(frozen=True)
class Reason:
    """One thing that is held against a result: its kind, a key of `KINDS`, and a sentence for a person."""

    kind: str
    text: str

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"unknown kind of reason {self.kind!r}: expected one of {', '.join(KINDS)}")


@dataclass(frozen=True)
class Trust:
    """Whether a result may be used, and what is held against it."""

    reasons: tuple[Reason, ...] = ()

    @property
    def usable(self) -> bool:
        """Whether bands, probabilities and horizons may be made from the result."""
        return not any(KINDS[reason.kind] for reason in self.reasons)

    @property
    def verdict(self) -> Verdict:
        """``usable``, ``doubtful`` (usable, with reasons to look at it) or ``unusable``."""
        return "unusable" if not self.usable else "doubtful" if self.reasons else "usable"

    @property
    def against(self) -> str:
        """The sentences that forbid the use of the result, or an empty text."""
        return "; ".join(reason.text for reason in self.reasons if KINDS[reason.kind])

    @property
    def texts(self) -> list[str]:
        """What is held against it, a sentence each."""
        return [reason.text for reason in self.reasons]

    def because(self, *reasons: Reason) -> "Trust":
        """The same with further reasons; a kind and text that stand already are not repeated."""
        return Trust(tuple(dict.fromkeys((*self.reasons, *reasons))))

    def content(self) -> dict[str, Any]:
        """The JSON content ``{usable, verdict, reasons: [{kind, text}]}``."""
        said = [{"kind": reason.kind, "text": reason.text} for reason in self.reasons]
        return {"usable": self.usable, "verdict": self.verdict, "reasons": said}


#: What is held against a result of a program that kept no verdict.
UNRECORDED = Reason(
    "unrecorded", "the file holds no hash or no verdict of the program that made it: what it says cannot be checked"
)


#: What is held against a result that leaves out mechanics which the cell states.
MECHANICS_LEFT_OUT = Reason(
    "mechanics-left-out",
    "the error motions that the cell states are left out of all bands; an estimate of fpcal identify has them",
)


#: What is held against a result that takes held values as exact.
HELD_EXACT = "held values are taken as exact: no band holds what they are off by (--hold consider does)"


def trust_of(content: Any) -> Trust:
    """The trust that a file states; `ValueError` if it contradicts itself or is not as `Trust.content` writes it."""
    if content is None:
        return Trust((UNRECORDED,))
    if not isinstance(content, Mapping) or set(content) != {"usable", "verdict", "reasons"}:
        raise ValueError("expected usable, verdict and reasons")
    reasons = content["reasons"]
    if not isinstance(reasons, list):
        raise ValueError("expected a list of reasons")
    for reason in reasons:
        if not isinstance(reason, Mapping) or set(reason) != {"kind", "text"} or not isinstance(reason["text"], str):
            raise ValueError("expected reasons with kind and text")
    found = Trust(tuple(Reason(str(reason["kind"]), reason["text"]) for reason in reasons))
    if (content["usable"], content["verdict"]) != (found.usable, found.verdict):
        raise ValueError(f"the reasons say {found.verdict}, the verdict {content['verdict']!r:.40}")
    return found


@dataclass(frozen=True)
class FitEvidence:
    """What a fit says of itself: the numbers that the rule looks at."""

    converged: bool
    starts: int
    n_rows: int
    chi2_data: float  # of the whitened data rows
    expected: float  # of chi2_data, if model, prior and noise are right
    p_value: float  # probability of a larger chi2_data
    sum_of_squares: float  # of data and prior
    p_total: float  # probability of a larger sum_of_squares
    rank: int
    worst: str  # the rows farthest from the fit, for a person
    # the same three of the readings' noise alone, error motions not counted: what sigma_um is held against
    chi2_noise: float
    expected_noise: float
    p_noise: float


def judge_fit(fit: FitEvidence, *more: Reason) -> Trust:
    """What is to be held against a fit, in the order in which it is said; `more` comes after it."""
    return Trust((*_reasons(fit), *more))


def _reasons(fit: FitEvidence) -> Iterable[Reason]:
    chi2 = f"chi-square of the data {plain(fit.chi2_data)}, expected {fit.expected:.1f} ({chance(fit.p_value)})"
    if not fit.converged:
        text = f"the fit did not converge from {fit.starts} starting points: do not use this estimate"
        yield Reason("not-converged", f"{text}; farthest from it: {fit.worst}; fpcal doctor tries what may be wrong")
    if fit.p_value < POOR_FIT_BELOW:
        yield Reason(
            "poor-fit",
            f"poor fit: {chi2}: the path model or sigma_um is wrong, some sweeps are off, or held values are stale; "
            "fpcal doctor tries what may be wrong",
        )
    elif fit.p_total < POOR_FIT_BELOW:
        yield Reason(
            "poor-fit",
            f"poor fit: sum of squares {plain(fit.sum_of_squares)} over data and prior, expected {fit.n_rows} "
            f"({chance(fit.p_total)}): parameters are far from their prior, which is too narrow, or they stand in for "
            "something that is not free (a gain, a runout); fpcal doctor tries what may be wrong",
        )
    elif fit.p_noise > 1.0 - POOR_FIT_BELOW and fit.expected_noise > LEAST_EXPECTED:
        yield Reason(
            "too-good-fit",
            f"the fit is too good: chi-square of the data {fit.chi2_noise:.3g}, expected {fit.expected_noise:.1f}: "
            "sigma_um is too large, and every band with it; check its unit and state the noise of one reading",
        )
    if fit.rank == 0:
        yield Reason("nothing-determined", "the data determine nothing: every value and sd is the prior's")
