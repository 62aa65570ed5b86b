"""What a campaign's report says, in words and tables."""

from dataclasses import dataclass
from importlib.metadata import version
from platform import python_version
from typing import Any

import numpy as np

from fpcal_bayes.analysis.campaign import CampaignFacts, TaskStanding
from fpcal_bayes.analysis.history import SessionResiduals, SinceCalibration, session_bounds
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.version import __version__
from fpcal_bayes.decision.decision import Decision
from fpcal_bayes.infer.posterior.diagnostics import MOST_RHAT
from fpcal_bayes.infer.tasks.prediction import BAND
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.report.table import Table, TableCell, figure_of, number, plain_table
from fpcal_bayes.report.tasks import angle_text, known
from fpcal_bayes.report.track import LEAST_HOURS, VERDICT_STYLES, decision_sentence, time_text
from fpcal_bayes.tracking.session import SessionOutcome

#: Word of each action, its class in the style sheet, and its meaning.
_ACTIONS = {
    "hold": ("Hold", "good", "The cell keeps its tolerance until then; nothing is to be measured before."),
    "out of reach": ("Out of reach", "bad", "No measurement brings the tasks into this tolerance."),
    "extrinsic": ("Re-identify", "caution", "A few sweeps now bring mirror and fibre back into tolerance."),
    "full": ("Recalibrate", "bad", "The whole calibration is to be made again."),
}
#: Sweeps that are for the robot too are said to be.
_LOOKS = {
    "robot": "The tolerance holds; these sweeps show whether the robot itself has changed.",
    "both": "A few sweeps bring mirror and fibre back into tolerance, and show whether the robot itself has changed.",
}
#: Sweeps after which the tolerance does not hold yet.
_FIRST = "One session is not enough: these sweeps are the first of two that bring mirror and fibre back into tolerance."
_MOST_RESIDUALS = 12
_LIBRARIES = ("numpy", "scipy", "numba", "filterpy", "h5py", "matplotlib")


@dataclass(frozen=True)
class Headline:
    """What to do, first thing on the page."""

    word: str
    title: str  # the action with its time
    style: str  # good, caution, bad: its class in the style sheet
    meaning: str  # the word in a sentence
    sentences: tuple[str, ...]


def verdict(facts: CampaignFacts) -> Headline:
    """Hold, re-identify or recalibrate; or why that cannot be said."""
    if facts.fit_is_wrong or not (facts.trust.usable or (facts.track is not None and facts.track.calibration_due)):
        meaning = "These numbers are not to be used: they rest on a fit that is wrong."
        said = f"{facts.trust.against[0].upper()}{facts.trust.against[1:]}."
        return Headline("Do not use", "Do not use", "bad", meaning, (said, f"What to do: fpcal doctor {facts.file}."))
    sentences = [_task_sentence(facts)]
    if facts.decision is None or facts.track is None:
        meaning = f"It cannot be said what to do: {facts.decision_reason}."
        return Headline("No verdict", "No verdict", "caution", meaning, tuple(sentences))
    word, title, style, meaning = _action(facts.decision, facts)
    if facts.verification is not None and facts.verification.failed:
        title, style = "Verification failed", "bad"
        meaning = "Sweeps that were not fitted contradict the calibration: measure them again, then calibrate anew."
    said = decision_sentence(facts.decision, facts.track)
    sentences.insert(0, said[0].upper() + said[1:] + ".")
    if facts.track.calibration_due is not None:
        sentences.append(f"The robot itself moved before session {facts.track.calibration_due}.")
    return Headline(word, title, style, meaning, tuple(sentences))


def _action(decision: Decision, facts: CampaignFacts) -> tuple[str, str, str, str]:
    """Word, title with the time, class of the style sheet, and meaning of what is to be done."""
    out_of_reach = decision.action == "hold" and decision.attainable_nm is not None
    word, style, meaning = _ACTIONS["out of reach" if out_of_reach else decision.action]
    if out_of_reach:
        title = f"{word}: at best {decision.attainable_nm:.3g} nm can be held"
    elif decision.action != "hold":
        looked = decision.action == "extrinsic" and decision.purpose == "robot"
        sweeps = counted(0 if decision.sweeps is None else len(decision.sweeps), "sweep")
        title = f"{'Look at the robot' if looked else word} now: {sweeps}, about {decision.minutes:.0f} min"
        if decision.action == "extrinsic":
            meaning = _LOOKS.get(decision.purpose, meaning if decision.then_hours >= LEAST_HOURS else _FIRST)
    elif decision.hold_hours < facts.costs.horizon_h:
        until = shown_time(decision.now_h + decision.hold_hours, facts)
        # Green is for what needs nobody's attention within the horizon.
        title, style = f"Measure again by {until}, in {decision.hold_hours:.1f} h", "caution"
    else:
        title = f"{word}: nothing to measure within {facts.costs.horizon_h:g} h"
    return word, title, style, meaning


def _task_sentence(facts: CampaignFacts) -> str:
    parts = []
    for outlook in facts.tasks:
        if not outlook.asked:
            continue
        found = outlook.numbers
        if found is None:
            parts.append(f"{outlook.name} cannot be driven ({outlook.reason})")
        elif found.exceeds is None:
            parts.append(f"{outlook.name} is not known: {facts.trust.against}")
        else:
            parts.append(f"{outlook.name} {found.median:.1f} nm peak to peak (at most {found.most:.1f} nm with 97.5 %)")
    return f"Expected now: {'; '.join(parts)}; tolerance {1e3 * facts.goal.tolerance_um:g} nm."


def standing(outlook: TaskStanding, facts: CampaignFacts) -> tuple[str, str]:
    """Where a task stands against the tolerance, in words, and the class of the style sheet."""
    if not facts.trust.usable:
        return "not known", "bad"
    risk = outlook.risk
    if risk is None:
        return "cannot be driven", "bad"
    if risk <= facts.goal.level:
        inside = outlook.numbers is not None and outlook.numbers.most <= 1e3 * facts.goal.tolerance_um
        return ("within tolerance", "good") if inside else ("probably within", "caution")
    return ("at risk", "caution") if risk <= 0.5 else ("out of tolerance", "bad")


def task_table(facts: CampaignFacts) -> Table:
    """Each task against the tolerance."""
    heads = ["task", "standing", f"P(above {1e3 * facts.goal.tolerance_um:g} nm)", "median [nm]"]
    heads += [f"{100 * BAND:g} % band [nm]", "mirror direction, 95 % [deg]", "to be held"]
    table = plain_table("Peak to peak of each task's error now", heads, words=(0, 1, 6))
    for outlook in facts.tasks:
        said, style = standing(outlook, facts)
        asked, found = "yes" if outlook.asked else "no", outlook.numbers
        if found is None or found.exceeds is None:
            reason = outlook.reason or facts.trust.against
            table.add_row(outlook.name, TableCell(f"{said}: {reason}", said, style), "", "", "", "", asked)
            continue
        table.add_row(
            outlook.name,
            TableCell(said, style=style),
            figure_of(found.exceeds, f"{found.exceeds:.3f}"),
            figure_of(found.median, f"{found.median:.1f}"),
            figure_of(found.most, f"{found.least:.1f} to {found.most:.1f}"),
            figure_of(found.normal[1], angle_text(found.normal[1])),
            asked,
        )
    return table


def measured_sentence(facts: CampaignFacts) -> str:
    """How much was measured over which time, and how many sessions were as modelled."""
    times, n = facts.sweeps.time_h, len(facts.sweeps.sessions)
    days = float(times.max() - times.min()) / 24.0
    sentence = f"{counted(len(facts.sweeps), 'row')} in {counted(n, 'session')}"
    sentence += f" over {days:.1f} days" if days > 0 else ""
    if facts.track is None or n == 1:
        return sentence + "."
    later = facts.track.outcomes[1:]
    moved = [outcome for outcome in later if outcome.verdict != "as-modelled"]
    if not moved:
        return f"{sentence}; after the calibration all were as modelled."
    named = ", ".join(f"{outcome.session} ({outcome.verdict})" for outcome in moved[:8])
    more = ", ..." if len(moved) > 8 else ""
    return f"{sentence}; of {len(later)} after the calibration {len(moved)} raised an alarm: {named}{more}."


def session_table(facts: CampaignFacts) -> Table:
    """What was measured, session by session, and what the tests say of it."""
    heads = ["session", "time", "verdict", "innovation", "95 % bounds", "rows", "sigma, median [nm]", "without sign"]
    table = plain_table("Sessions", heads, words=(0, 2))
    outcomes = {} if facts.track is None else {outcome.session: outcome for outcome in facts.track.outcomes}
    for i, name in enumerate(facts.sweeps.sessions):
        rows = facts.sweeps.of_session(name)
        time_h, unsigned = float(rows.time_h.max()), int((~rows.signed).sum())
        table.add_row(
            name,
            figure_of(time_h, shown_time(time_h, facts)),
            *_tested(outcomes.get(name), first=i == 0),
            figure_of(len(rows), str(len(rows))),
            figure_of(1e3 * float(np.median(rows.sigma))),
            figure_of(unsigned, str(unsigned)),
        )
    return table


def _tested(outcome: SessionOutcome | None, *, first: bool) -> list[str | TableCell]:
    """Headline, innovation and bounds."""
    if outcome is None:
        return ["not followed", "", ""]
    said, style = ("calibration", "good") if first else (outcome.verdict, VERDICT_STYLES[outcome.verdict])
    word = TableCell(said, style=style)
    bounds = session_bounds(outcome)
    if bounds is None:
        return [word, "", ""]
    low, high = bounds
    return [word, figure_of(outcome.nis, f"{outcome.nis:.1f}"), TableCell(f"{low:.1f} to {high:.1f}", f"{high:.6g}")]


def parameter_table(facts: CampaignFacts) -> Table:
    """Each parameter now: value, 95 % interval, status; beside it the calibration and the prior."""
    heads = ["parameter", "value", "sd", "unit", "status"]
    heads += ["95 % interval", "at calibration", "sd / prior sd", "belongs to"]
    table = plain_table("Parameters now", heads, words=(0, 3, 4, 8))
    estimate, before = facts.estimate, facts.calibration.estimate.shown()
    now = estimate.shown()
    for parameter, status in zip(estimate.parameters, estimate.status, strict=True):
        value, sd = now[parameter.name]["value"], now[parameter.name]["sd"]
        low, high = value - 1.96 * sd, value + 1.96 * sd
        was = before.get(parameter.name)
        share = sd / parameter.shown(parameter.prior_sd)
        table.add_row(
            parameter.name,
            figure_of(value, number(value, sd)),
            figure_of(sd, number(sd, sd)),
            parameter.unit,
            TableCell(status, style=status),
            figure_of(low, f"{number(low, sd)} to {number(high, sd)}"),
            "" if was is None else figure_of(was["value"], number(was["value"], was["sd"])),
            figure_of(share, f"{100 * share:.1f} %"),
            parameter.kind,
        )
    return table


def since_content(since: SinceCalibration | None) -> dict[str, Any] | None:
    """What changed since the last calibration, as JSON; null where two sessions cannot be compared."""
    if since is None:
        return None
    changes = zip(since.parameters, since.change.tolist(), since.sd.tolist(), strict=True)
    return {
        "calibration": since.session,
        "hours": since.hours,
        "parameters": {p.name: {"change": change, "sd": known(sd), "unit": p.unit} for p, change, sd in changes},
        "tasks": {
            task.name: {"change_nm": task.change, "expected_nm": {"median": task.expected, "q97.5": task.most}}
            for task in since.tasks
        },
        "chi2": since.chi2,
        "dof": since.dof,
        "p_value": since.p_value,
        "drift_explains": since.explained,
    }


def since_sentence(since: SinceCalibration | None) -> str:
    """Whether the stated drift explains what changed since the last calibration."""
    if since is None:
        return "There are no two sessions to compare."
    told = f"chi-square {since.chi2:.1f} in {counted(since.dof, 'direction')}, p = {since.p_value:.2g}"
    word = "the stated drift explains it" if since.explained else "more than the stated drift explains"
    advice = "" if since.explained else " Calibrate in full, or let fpcal track --fit-drift find this cell's drift."
    return f"From {since.session} to the last session, {since.hours:.1f} h: {told}: {word}.{advice}"


def since_tables(since: SinceCalibration | None) -> list[Table]:
    """Change of each task and each parameter since the last calibration, beside what the stated drift lets expect."""
    if since is None:
        return []
    title = "Error of each task if the calibration is still driven, peak to peak"
    tasks = plain_table(title, ["task", "found [nm]", "expected, median [nm]", "expected, 97.5 % [nm]"], words=(0,))
    for task in since.tasks:
        tasks.add_row(task.name, *(figure_of(size, f"{size:.1f}") for size in (task.change, task.expected, task.most)))
    parameters = plain_table("Change of the parameters", ["parameter", "unit", "change", "expected sd", "in sd"])
    for p, change, sd in zip(since.parameters, since.change.tolist(), since.sd.tolist(), strict=True):
        if sd == sd:
            shown = [figure_of(change, number(change, sd)), figure_of(sd, number(sd, sd))]
            parameters.add_row(p.name, p.unit, *shown, figure_of(change / sd, f"{change / sd:+.1f}"))
    return [tasks, parameters]


def residual_table(parts: list[SessionResiduals]) -> Table:
    """The rows that the estimate of their session meets worst."""
    residuals = [(part.session, *row) for part in parts for row in zip(part.labels, part.values.tolist(), strict=True)]
    table = plain_table("Largest residuals", ["session", "sweep", "residual / sigma"])
    for session, label, value in sorted(residuals, key=lambda entry: -abs(entry[2]))[:_MOST_RESIDUALS]:
        table.add_row(session, label, figure_of(value, f"{value:+.2f}"))
    return table


def posterior_sentence(facts: CampaignFacts) -> str:
    """What the draws are worth, or how to make them."""
    found = facts.posterior
    if found is None:
        return (
            f"Not sampled. The intervals on this page are those of a normal distribution at the maximum. Draw with: "
            f"fpcal sample {facts.file} -o posterior.nc, then give the report --posterior posterior.nc."
        )
    worth = found.diagnostics
    word = "The draws have converged" if worth.rhat.max() < MOST_RHAT else "The draws have NOT converged"
    outside = int((np.abs(found.residuals) > 1.96).sum())
    return (
        f"{word}: largest nested R-hat {worth.rhat.max():.4f} over {found.n_ensembles} independent ensembles (expected "
        f"below {MOST_RHAT:g}); {found.n_draws} draws are worth at least {worth.ess_bulk.min():.0f} independent ones. "
        f"{outside} of {len(found.residuals)} measured rows lie outside the 95 % that the posterior predicts for them."
    )


def budget_sentence(facts: CampaignFacts) -> str:
    """What stands in the budget, and what is left of it now."""
    budget, now = facts.budget, facts.tasks[0].numbers
    if budget is None:
        return ""
    sentence = "As after the calibration; the coverage interval is by Monte Carlo (JCGM 100, 101)."
    if now is None or now.exceeds is None:
        return sentence
    return f"{sentence} Now, after all sessions and the drift since, {now.worst_sd:.2f} nm are left at the worst point."


def mechanics_table(estimate: Estimate) -> Table | None:
    """What the calibration says of the stated sizes of the error motions, or None on a perfect mechanism."""
    known = estimate.mechanics
    if known is None:
        return None
    table = plain_table("", ["sizes", "times the stated", "95 %"])
    low, middle, high = np.exp(np.quantile(known.log_scales, [0.025, 0.5, 0.975], axis=0))
    for i, name in enumerate(known.scales):
        table.add_row(name, f"{middle[i]:.2g}", f"{low[i]:.2g} .. {high[i]:.2g}")
    return table


def mechanics_sentence(estimate: Estimate) -> str:
    """What the numbers assume of the mechanism."""
    if estimate.mechanics is None:
        return "The mechanism is taken as perfect: no error motion, no reversal, no return error."
    sources = {joint.source or "no source stated" for joint in estimate.mechanics.sizes.joints}
    return (
        f"Sizes as the cell states them ({', '.join(sorted(sources))}). The calibration finds geometry "
        "and error motions together; the filter of the drift follows both."
    )


def provenance(facts: CampaignFacts) -> list[tuple[str, str]]:
    """Where the numbers come from."""
    cell, campaign, posterior = facts.cell, facts.campaign, facts.posterior
    rows = [
        ("data", f"{facts.file}, sha256 {facts.sha256}"),
        ("cell", f"{cell.name}, path model {cell.opd}, sha256 {cell.sha256}"),
    ]
    if campaign is not None:
        command = campaign.command or "command not stated"
        rows.append(("data made by", f"fpcal_bayes {campaign.program_version}: {command}"))
        rows.append(("seed of the data", "none: not simulated" if campaign.seed is None else str(campaign.seed)))
    if posterior is not None:
        rows.append(("posterior", f"{posterior.file}, sha256 {posterior.sha256}; {posterior.command}"))
    rows.append(("report made by", f"fpcal_bayes {__version__}: {facts.command or 'the Python interface'}"))
    rows.append(("report for the time", shown_time(facts.now_h, facts)))
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return [*rows, ("versions", f"Python {python_version()}, {libraries}")]


def shown_time(time_h: float, facts: CampaignFacts) -> str:
    """A time as clock time where the sessions carry one, else in hours since the campaign began."""
    return f"{time_h:.2f} h" if facts.track is None else time_text(time_h, facts.track.outcomes)
