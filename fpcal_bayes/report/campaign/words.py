"""What a campaign's report says, in words and tables."""

from dataclasses import dataclass
from importlib.metadata import version
from platform import python_version

import numpy as np

from fpcal_bayes.analysis.campaign import CampaignFacts, TaskOutlook
from fpcal_bayes.core.version import __version__
from fpcal_bayes.infer.tasks.budget import COVERAGE, Budget
from fpcal_bayes.infer.tasks.prediction import BAND
from fpcal_bayes.report.fit import number
from fpcal_bayes.report.table import Cell, PageTable, figure_of, table
from fpcal_bayes.report.track import decision_sentence, time_text
from fpcal_bayes.tracking.tracker import innovation_bounds

_ACTIONS = {
    "hold": ("Hold", "good", "The cell keeps its tolerance; nothing is to be measured now."),
    "extrinsic": ("Re-identify", "caution", "A few sweeps now bring mirror and fibre back into tolerance."),
    "full": ("Recalibrate", "bad", "The whole calibration is to be made again."),
}
_LIBRARIES = ("numpy", "scipy", "numba", "filterpy", "h5py", "matplotlib")


@dataclass(frozen=True)
class Verdict:
    """What to do, first thing on the page.

    Attributes
    ----------
    word, style
        One word, and its class in the style sheet: ``good``, ``caution``, ``bad``.
    meaning, sentences
        The word in a sentence, and the sentences below it.
    """

    word: str
    style: str
    meaning: str
    sentences: tuple[str, ...]


def verdict(facts: CampaignFacts) -> Verdict:
    """Hold, re-identify or recalibrate; or why that cannot be said."""
    if facts.unusable:
        meaning = "These numbers are not to be used: they rest on a fit that is wrong."
        said = f"{facts.unusable[0].upper()}{facts.unusable[1:]}."
        return Verdict("Do not use", "bad", meaning, (said, f"What to do: fpcal doctor {facts.file}."))
    sentences = [_task_sentence(facts)]
    if facts.decision is None or facts.track is None:
        return Verdict(
            "No verdict", "caution", f"It cannot be said what to do: {facts.decision_reason}.", tuple(sentences)
        )
    word, style, meaning = _ACTIONS[facts.decision.action]
    said = decision_sentence(facts.decision, facts.track)
    sentences.insert(0, said[0].upper() + said[1:] + ".")
    if facts.track.calibration_due is not None:
        sentences.append(f"The robot itself moved before session {facts.track.calibration_due}.")
    return Verdict(word, style, meaning, tuple(sentences))


def _task_sentence(facts: CampaignFacts) -> str:
    parts = []
    for outlook in facts.tasks:
        if not outlook.asked:
            continue
        if outlook.prediction is None:
            parts.append(f"{outlook.name} cannot be driven ({outlook.reason})")
            continue
        median = 1e3 * float(np.median(outlook.prediction.peak_to_peak))
        high = 1e3 * float(outlook.prediction.peak_to_peak_band()[1])
        parts.append(f"{outlook.name} {median:.1f} nm peak to peak (at most {high:.1f} nm with 97.5 %)")
    return f"Expected now: {'; '.join(parts)}; tolerance {1e3 * facts.goal.tolerance:g} nm."


def standing(outlook: TaskOutlook, facts: CampaignFacts) -> tuple[str, str]:
    """Where a task stands against the tolerance, in words, and the class of the style sheet."""
    if facts.unusable:
        return "not known", "bad"
    if outlook.prediction is None:
        return "cannot be driven", "bad"
    risk = outlook.prediction.exceeds(facts.goal.tolerance)
    if risk <= facts.goal.level:
        return "within tolerance", "good"
    return ("at risk", "caution") if risk <= 0.5 else ("out of tolerance", "bad")


def task_table(facts: CampaignFacts) -> PageTable:
    """Each task against the tolerance."""
    rows = []
    for outlook in facts.tasks:
        words, style = standing(outlook, facts)
        asked = "yes" if outlook.asked else "no"
        if outlook.prediction is None:
            rows.append(
                [Cell(outlook.name), Cell(asked), Cell(f"{words}: {outlook.reason}", words, style), *[Cell("")] * 4]
            )
            continue
        found = outlook.prediction
        low, high = 1e3 * found.peak_to_peak_band()
        normal = float(np.quantile(found.angles.normal.max(axis=1), 0.95))
        rows.append(
            [
                Cell(outlook.name),
                Cell(asked),
                Cell(words, style=style),
                figure_of(1e3 * float(np.median(found.peak_to_peak)), f"{1e3 * np.median(found.peak_to_peak):.2f}"),
                figure_of(high, f"{low:.2f} to {high:.2f}"),
                figure_of(found.exceeds(facts.goal.tolerance), f"{found.exceeds(facts.goal.tolerance):.3f}"),
                figure_of(normal, f"{normal:.2g}" if normal > 1e-9 else "0"),
            ]
        )
    columns = (
        "task", "to be held", "standing", "peak to peak, median [nm]", f"{BAND:.0%} band [nm]",
        f"P(above {1e3 * facts.goal.tolerance:g} nm)", "mirror direction, 95 % [deg]",
    )  # fmt: skip
    return table("Error of each task now", columns, rows, (0, 1, 2))


def measured_sentence(facts: CampaignFacts) -> str:
    """How much was measured over which time, and how many sessions were as modelled."""
    times, n = facts.sweeps.time_h, len(facts.sweeps.sessions)
    sessions = f"{n} sessions" if n > 1 else "one session"
    days = float(times.max() - times.min()) / 24.0
    sentence = f"{len(facts.sweeps)} rows in {sessions}" + (f" over {days:.1f} days" if days > 0 else "")
    if facts.track is None or n == 1:
        return sentence + "."
    later = facts.track.outcomes[1:]
    moved = [outcome for outcome in later if outcome.verdict != "as-modelled"]
    if not moved:
        return f"{sentence}; after the calibration all were as modelled."
    named = ", ".join(f"{outcome.session} ({outcome.verdict})" for outcome in moved[:8])
    more = ", ..." if len(moved) > 8 else ""
    return f"{sentence}; of {len(later)} after the calibration {len(moved)} raised an alarm: {named}{more}."


def session_table(facts: CampaignFacts) -> PageTable:
    """What was measured, session by session, and what the tests say of it."""
    rows = []
    outcomes = {} if facts.track is None else {outcome.session: outcome for outcome in facts.track.outcomes}
    for i, name in enumerate(facts.sweeps.sessions):
        part = facts.sweeps.of_session(name)
        outcome = outcomes.get(name)
        unsigned = int((~part.signed).sum())
        rows.append(
            [
                Cell(name),
                figure_of(float(part.time_h.max()), shown_time(float(part.time_h.max()), facts)),
                figure_of(len(part), str(len(part))),
                figure_of(1e3 * float(np.median(part.sigma))),
                figure_of(unsigned, str(unsigned)),
                *([Cell("not followed"), Cell(""), Cell("")] if outcome is None else _tested(outcome, first=i == 0)),
            ]
        )
    columns = ("session", "time", "rows", "sigma, median [nm]", "without sign", "verdict", "innovation", "95 % bounds")
    return table("Sessions", columns, rows, (0, 5))


def _tested(outcome: object, *, first: bool) -> list[Cell]:
    from fpcal_bayes.tracking.session import SessionOutcome

    assert isinstance(outcome, SessionOutcome)
    low, high = innovation_bounds(outcome.dof) if outcome.dof else (np.nan, np.nan)
    bounds = Cell(f"{low:.1f} to {high:.1f}", f"{high:.6g}") if outcome.dof else Cell("")
    style = {"as-modelled": "good", "extrinsics-moved": "caution", "intrinsics-moved": "bad"}[outcome.verdict]
    word = Cell("calibration", style="good") if first else Cell(outcome.verdict, style=style)
    return [word, figure_of(outcome.nis, f"{outcome.nis:.1f}") if outcome.dof else Cell(""), bounds]


def parameter_table(facts: CampaignFacts) -> PageTable:
    """Each parameter now: value, 95 % interval, status; beside it the calibration and the prior."""
    estimate, first = facts.estimate, facts.observability
    found = first.identification
    assert found is not None
    before, now = found.estimate.shown(), estimate.shown()
    rows = []
    for parameter, status in zip(estimate.parameters, estimate.status, strict=True):
        value, sd = now[parameter.name]["value"], now[parameter.name]["sd"]
        low, high = number(value - 1.96 * sd, sd), number(value + 1.96 * sd, sd)
        was = before.get(parameter.name)
        prior = parameter.shown(parameter.prior_sd)
        rows.append(
            [
                Cell(parameter.name),
                Cell(parameter.kind),
                Cell(parameter.unit),
                Cell(status, style=status),
                figure_of(value, number(value, sd)),
                figure_of(sd, number(sd, sd)),
                figure_of(low_key(value, sd), f"{low} to {high}"),
                Cell("") if was is None else figure_of(was["value"], number(was["value"], was["sd"])),
                figure_of(sd / prior, f"{100 * sd / prior:.1f} %"),
            ]
        )
    columns = (
        "parameter",
        "belongs to",
        "unit",
        "status",
        "value",
        "sd",
        "95 % interval",
        "at calibration",
        "sd / prior sd",
    )
    return table("Parameters now", columns, rows, (0, 1, 2, 3))


def low_key(value: float, sd: float) -> float:
    """Lower end of the 95 % interval."""
    return value - 1.96 * sd


def residual_table(residuals: list[tuple[str, str, float]], most: int = 12) -> PageTable:
    """The rows that the estimate of their session meets worst."""
    worst = sorted(residuals, key=lambda entry: -abs(entry[2]))[:most]
    rows = [[Cell(session), Cell(label), figure_of(value, f"{value:+.2f}")] for session, label, value in worst]
    return table("Largest residuals", ("session", "sweep", "residual / sigma"), rows, (0, 1))


def posterior_table(facts: CampaignFacts) -> PageTable | None:
    """Mean, interval and worth of the draws of each parameter."""
    found = facts.posterior
    if found is None:
        return None
    flat = found.draws.reshape(-1, len(found.parameters))
    rows = []
    for i, parameter in enumerate(found.parameters):
        values = flat[:, i]
        sd = float(values.std(ddof=1))
        low, middle, high = (float(q) for q in np.quantile(values, [0.025, 0.5, 0.975]))
        rows.append(
            [
                Cell(parameter.name),
                Cell(parameter.unit),
                figure_of(middle, number(middle, sd)),
                figure_of(low, f"{number(low, sd)} to {number(high, sd)}"),
                figure_of(float(found.ess_bulk[i]), f"{found.ess_bulk[i]:.0f}"),
                figure_of(float(found.ess_tail[i]), f"{found.ess_tail[i]:.0f}"),
                figure_of(float(found.rhat[i]), f"{found.rhat[i]:.4f}"),
            ]
        )
    columns = ("parameter", "unit", "median", "95 % interval", "effective draws", "in the tails", "R-hat")
    return table("Posterior of the calibration", columns, rows, (0, 1))


def posterior_sentence(facts: CampaignFacts) -> str:
    """What the draws are worth, or how to make them."""
    found = facts.posterior
    if found is None:
        return (
            f"Not sampled. The intervals on this page are those of a normal distribution at the maximum. Draw with: "
            f"fpcal sample {facts.file} -o posterior.nc, then give the report --posterior posterior.nc."
        )
    from fpcal_bayes.infer.posterior.diagnostics import MOST_RHAT

    good = bool(found.rhat.max() < MOST_RHAT)
    word = "The draws have converged" if good else "The draws have NOT converged"
    outside = int((np.abs(found.residuals) > 1.96).sum())
    return (
        f"{word}: largest nested R-hat {found.rhat.max():.4f} over {found.n_ensembles} independent ensembles (expected "
        f"below {MOST_RHAT:g}); {found.n_draws} draws are worth at least {found.ess_bulk.min():.0f} independent ones. "
        f"{outside} of {len(found.residuals)} measured rows lie outside the 95 % that the posterior predicts for them."
    )


def budget_table(budget: Budget) -> PageTable:
    """Each input of the budget and what it contributes; shares where the inputs are independent."""
    total = budget.combined**2
    independent = total > 0 and bool(np.allclose(budget.correlation, np.eye(len(budget.lines)), atol=1e-6))
    rows = [
        [
            Cell(line.name),
            Cell(line.evaluation),
            Cell(line.distribution),
            figure_of(line.standard_uncertainty, f"{line.standard_uncertainty:.3g} {line.unit}"),
            figure_of(1e3 * line.sensitivity, f"{1e3 * line.sensitivity:.3g} / {line.unit}"),
            figure_of(1e3 * line.contribution),
            *([figure_of(line.contribution**2 / total, f"{100 * line.contribution**2 / total:.1f} %")] * independent),
        ]
        for line in budget.lines
    ]
    columns = ("input", "type", "distribution", "std. uncertainty", "sensitivity [nm]", "contribution [nm]")
    caption = f"Uncertainty budget of {budget.task} at {budget.along:.4g} {budget.unit}, after the calibration"
    return table(caption, (*columns, *(["share of the variance"] * independent)), rows, (0, 1, 2))


def budget_sentence(facts: CampaignFacts) -> str:
    """What the inputs combine to, and what is left of it now."""
    budget, now = facts.budget, facts.tasks[0].prediction
    if budget is None:
        return ""
    low, high = (1e3 * edge for edge in budget.interval)
    sentence = (
        f"Combined standard uncertainty {1e3 * budget.combined:.2f} nm; {COVERAGE:.0%} coverage interval {low:.2f} to "
        f"{high:.2f} nm, by Monte Carlo (JCGM 100, 101)."
    )
    if now is None:
        return sentence
    left = f"{1e3 * now.sd.max():.2f} nm"
    return f"{sentence} Now, after all sessions and the drift since, {left} are left at the worst point."


def provenance(facts: CampaignFacts) -> list[tuple[str, str]]:
    """Where the numbers come from."""
    cell, campaign = facts.cell, facts.campaign
    rows = [
        ("data", f"{facts.file}, sha256 {facts.sha256}"),
        ("cell", f"{cell.name}, path model {cell.opd}, sha256 {cell.sha256}"),
    ]
    if campaign is not None:
        rows.append(
            ("data made by", f"fpcal_bayes {campaign.program_version}: {campaign.command or 'command not stated'}")
        )
        rows.append(("seed of the data", "none: not simulated" if campaign.seed is None else str(campaign.seed)))
    if facts.posterior is not None:
        rows.append(
            ("posterior", f"{facts.posterior.file}, sha256 {facts.posterior.sha256}; {facts.posterior.command}")
        )
    rows.append(("report made by", f"fpcal_bayes {__version__}: {facts.command or 'the Python interface'}"))
    rows.append(("report for the time", shown_time(facts.now_h, facts)))
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return [*rows, ("versions", f"Python {python_version()}, {libraries}")]


def shown_time(time_h: float, facts: CampaignFacts) -> str:
    """A time as clock time where the sessions carry one, else in hours since the campaign began."""
    return f"{time_h:.2f} h" if facts.track is None else time_text(time_h, facts.track.outcomes)
