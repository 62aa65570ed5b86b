"""What the fit of each session, and the track of all, say about a campaign."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted, plain
from fpcal_bayes.infer.design.commission import LABEL
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.mistakes import RIVAL_EXCESS, mend, mirror_sets
from fpcal_bayes.infer.observability.observe import observe
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.axes import direction_words, home, joint_axes, sight
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.trust import POOR_FIT_BELOW
from fpcal_bayes.tracking.tracker import track

Severity = Literal["problem", "doubt", "note"]

_OUTLIER = 5.0
#: A few rows spoil a fit if without them its chi-square falls to the usual.
_MOST_OUTLIERS = 0.1


@dataclass(frozen=True)
class Finding:
    """One thing that a reader of the campaign should know."""

    severity: Severity  # problem: results are wrong or cannot be had; doubt: they may be; note: good to know
    kind: str  # a short name, the same for all findings of a kind
    where: str  # session, or empty for the whole file
    what: str
    remedy: str

    def content(self) -> dict[str, Any]:
        """For JSON."""
        return {("session" if name == "where" else name): text for name, text in vars(self).items()}


def session_fits(sweeps: Sweeps, cell: Cell) -> Iterator[Finding]:
    """Fit each measured session that can stand alone, and follow all of them."""
    for number, name in enumerate(sweeps.sessions):
        part = sweeps.of_session(name)
        used = part.take(part.kind != "path")
        # A later session with fewer rows than parameters is judged by the track only.
        if len(used) < len(cell.free) and number:
            continue
        if not len(used):
            what = "holds paths only"
            yield Finding("problem", "rows", name, what, "measure sweeps first: the first session calibrates")
            continue
        found = identify(cell, used)
        if number == 0 and found.estimate.trust.usable:
            yield from _rank(cell, used)
        yield from _fit(cell, name, used, found)
    if len(sweeps.sessions) > 1:
        yield from _track(cell, sweeps)


def _rank(cell: Cell, used: Sweeps) -> Iterator[Finding]:
    seen = observe(cell, used)
    hidden = [gauge for gauge in seen.gauges if gauge.layer == "model"]
    if hidden:
        names = ", ".join(dict.fromkeys(gauge.parameters[0] for gauge in hidden))
        what = f"no trace in any cavity length: {counted(len(hidden), 'combination')} ({names})"
        yield Finding("note", "gauges", str(used.session[0]), what, "nothing: no task depends on them")
    for gauge in seen.gauges:
        if gauge.layer != "model":
            yield Finding("doubt", "rank", str(used.session[0]), gauge.explanation, gauge.remedy)
    if seen.spectrum.gap < 1e3:
        what = "it is not clear-cut which combinations the sweeps see"
        remedy = "vary the sweeps more: other orientations, longer translations (fpcal plan proposes some)"
        yield Finding("doubt", "rank", str(used.session[0]), what, remedy)


def _fit(cell: Cell, name: str, used: Sweeps, found: Identification) -> Iterator[Finding]:
    reasons = {reason.kind: reason.text for reason in found.estimate.trust.reasons}
    if "signs" in reasons:
        remedy = "scan the wavelength before and after these sweeps, or leave them out"
        yield Finding("doubt", "signs", name, reasons["signs"], remedy)
    if "second-solution" in reasons and found.estimate.trust.usable:
        what = reasons["second-solution"]
        yield Finding("doubt", "second solution", name, what, "measure what tells the two apart and identify again")
    if {"not-converged", "poor-fit"} & set(reasons):
        yield from _poor_fit(cell, name, used, found)
        return
    if "slips" in reasons:
        yield Finding("problem", "slips", name, reasons["slips"], _COUNT_AGAIN)
        return
    for reason in found.estimate.trust.reasons:
        if reason.kind == "mechanics":
            remedy = "find out what moves, or state the size that the rows show in [joint.mechanics]"
            yield Finding(
                "doubt", "mechanics", name, reason.text.removesuffix("; fpcal doctor says what to do"), remedy
            )
        elif reason.kind == "residuals":
            yield Finding("doubt", "residuals", name, reason.text, _residual_remedy(reason.text))
    if str(used.label[-1]).startswith(LABEL):
        yield from _commissioned(cell, name, found)
    if "too-good-fit" in reasons:
        what = f"the rows lie closer to the fit than sigma_um says: {reasons['too-good-fit']}"
        remedy = "check the unit of sigma_um; what readings show that are repeated without any motion is its size"
        yield Finding("doubt", "sigma", name, what, remedy)


def _commissioned(cell: Cell, name: str, found: Identification) -> Iterator[Finding]:
    """What the sweeps of a commissioning tell of the axes, and what they cannot tell."""
    rivals = mend(found.problem, found.solution, found.fit.standardised)
    alike = [one.name for one in rivals if one.sum_of_squares < found.solution.sum_of_squares + RIVAL_EXCESS]
    if alike:
        remedy = "repeat the sweeps with larger moves, or with a smaller sigma_um"
        yield Finding("doubt", "not told apart", name, f"the rows fit as well if {', or '.join(alike[:3])}", remedy)
    seen = sight(cell, found.estimate.vector(), home(cell))
    yield Finding(
        "note", "commissioned", name,
        "signs, order and scales of the axes, and the side of the fibre, are as the cell says; at joint zero the "
        f"mirror stands {np.degrees(seen.tilt):.2g} deg off the light",
        "nothing, if that is where joint zero is meant to be",
    )  # fmt: skip
    images = [set(one) for one in mirror_sets(cell)]
    if not images or cell.handedness_checked:
        return
    sets = " or ".join("{" + ", ".join(f"q{j + 1}" for j in sorted(one)) + "}" for one in images)
    directions, _ = joint_axes(cell, cell.parameters.nominal, home(cell))
    looks, left = [], images
    while left:
        # The joint that most of the images turn round.
        joint = max(range(len(cell.joints)), key=lambda j: (sum(j in one for one in left), not cell.revolute[j]))
        verb = "turns about" if cell.revolute[joint] else "moves along"
        looks.append(f"q{joint + 1} {verb} {direction_words(directions[joint])}")
        left = [one for one in left if joint not in one]
    yield Finding(
        "doubt", "handedness", name,
        f"with {sets} counted the other way every length is the same: none tells the cell from its mirror images",
        f"move and look: {', '.join(looks)}? If so, write handedness_checked = true into the cell; else mend the signs",
    )  # fmt: skip


def _residual_remedy(text: str) -> str:
    """What to do about a term that the residuals show: white excess is return error, the rest has its own name."""
    term = text.split(":")[0]
    if term.startswith("function of"):
        return f"look at {term.split()[-1]}: its straightness, linearity or runout is larger than stated, or its scale"
    if term.startswith("direction"):
        return f"state reversal_nm or reversal_urad of {term.split()[-1]}, or drive it from one side only"
    if term.startswith("order"):
        return "the cell drifts while measured: state drift_nm_per_min, give t_start_h and t_end_h, or wait longer"
    return _RETURN


_COUNT_AGAIN = "count the fringes of these sweeps again, or sample with --likelihood slip; fpcal track corrects them"
#: What white excess is put to: never to sigma alone, which mends the fit and not the tasks.
_RETURN = (
    "state a larger return_nm or return_urad of the joints that move, which fit and tasks then count; raise sigma_um "
    "only if readings that are repeated without any motion show it"
)


def _poor_fit(cell: Cell, name: str, used: Sweeps, found: Identification) -> Iterator[Finding]:
    """Why a fit is poor: a mistake in all rows, slips, a few rows, the path model, or what nobody states."""
    fit = found.fit
    against = found.estimate.trust.against.split(";")[0]
    poor = found.converged and fit.p_value < POOR_FIT_BELOW
    size = f"chi-square {plain(fit.chi2_data)}, expected {fit.expected:.1f}" if poor else against
    mended = mend(found.problem, found.solution, fit.standardised)
    if mended:
        fits = " or ".join(f"{one.name} (sum of squares {plain(one.sum_of_squares)})" for one in mended[:3])
        what = f"{size}; the {len(used)} rows fit if {fits}"
        yield Finding("problem", "mistake", name, what, "correct it where the file is made, and identify again")
        return
    slips = next((reason.text for reason in found.estimate.trust.reasons if reason.kind == "slips"), None)
    if slips is not None:
        yield Finding("problem", "slips", name, f"{size}; {slips}", _COUNT_AGAIN)
        return
    off = np.abs(fit.standardised) > _OUTLIER
    if 0 < off.sum() <= max(1, _MOST_OUTLIERS * len(used)) and len(used) - off.sum() >= len(cell.free):
        again = identify(cell, used.take(~off))
        if again.converged and again.estimate.trust.usable:
            rows = ", ".join(str(label) for label in used.label[off][:6])
            what = f"{size}; without {rows} it is {again.fit.chi2_data:.1f}"
            remedy = "measure these sweeps again, or sample with --likelihood student"
            yield Finding("problem", "outliers", name, what, remedy)
            return
    rival = identify(_other(cell), used)
    if rival.converged and (not found.converged or rival.fit.chi2_data < 0.5 * fit.chi2_data):
        what = f"{size}; with --opd {rival.estimate.cell.opd} chi-square is {plain(rival.fit.chi2_data)}"
        remedy = f"compare the two: fpcal compare FILE --models opd={cell.opd},opd={_other(cell).opd}"
        yield Finding("problem", "path model", name, what, remedy)
        if rival.estimate.trust.usable:
            return
    if not found.converged:
        worst = ", ".join(f"{label} {value:+.3g} sd" for label, value in found.largest_residuals(3))
        remedy = "look for a wrong pose, unit or sign in these rows; try fewer free parameters"
        yield Finding("problem", "convergence", name, f"{size}; farthest from it: {worst}", remedy)
    elif found.machine is None and fit.chi2_data < 100 * fit.expected:
        yield Finding(
            "problem", "fit", name,
            f"{size}: {np.sqrt(fit.chi2_data / fit.expected):.1f} times as far from the fit as sigma_um says",
            "do not use this estimate; look for drift in the session, and let the cell state its error motions "
            "([joint.mechanics], without --mechanics none), which fit and tasks then count; another sigma_um would "
            "mend this number and not the tasks",
        )  # fmt: skip
    else:
        yield Finding(
            "problem", "fit", name, size,
            "do not use this estimate; check the cell (signs, units, order of the joints), the poses, and whether the "
            "cell moved during the session",
        )  # fmt: skip


def _other(cell: Cell) -> Cell:
    return cell.with_opd("perpendicular" if cell.opd == "axis" else "axis")


def _track(cell: Cell, sweeps: Sweeps) -> Iterator[Finding]:
    """What shows only from session to session."""
    try:
        found = track(cell, sweeps)
    except InputError as error:
        remedy = "see the other findings; each session can still be identified alone with --session NAME"
        yield Finding("problem", "track", "", f"the sessions cannot be followed: {error}", remedy)
        return
    remedies = {
        "extrinsics-moved": "see what touched mirror or fibre; the track has followed it",
        "intrinsics-moved": "calibrate in full: the robot itself changed",
        "mechanics-moved": "calibrate in full: the error motions of the joints changed",
    }
    for outcome in found.outcomes[1:]:
        if outcome.verdict != "as-modelled":
            what = "; ".join(outcome.evidence)
            yield Finding("doubt", outcome.verdict, outcome.session, what, remedies[outcome.verdict])
        for warning in outcome.warnings:
            yield Finding("note", "rows", outcome.session, warning, "measure these rows again if they matter")
