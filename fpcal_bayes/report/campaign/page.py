"""The report of a campaign: one page that needs nothing else."""

from pathlib import Path
from typing import Any

from markupsafe import Markup

from fpcal_bayes.analysis.campaign import CampaignFacts, gather
from fpcal_bayes.analysis.files import summarise
from fpcal_bayes.analysis.history import history, outlooks, residuals, since_calibration
from fpcal_bayes.analysis.motions import motion_curves
from fpcal_bayes.core.files import write_text
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report import observe as observe_words
from fpcal_bayes.report import observe_figures
from fpcal_bayes.report.campaign import charts as data
from fpcal_bayes.report.campaign import figures, words
from fpcal_bayes.report.campaign.charts import log_table
from fpcal_bayes.report.pages import ENVIRONMENT, packaged, svg_panels
from fpcal_bayes.report.posterior import posterior_table
from fpcal_bayes.report.tasks import budget_table, freedom_table, not_evaluated_line
from fpcal_bayes.report.track import sweep_table
from fpcal_bayes.report.verification import power_table, verification_sentences

_SCRIPTS = (("vendor", "sortable.auto.min.js"), ("vendor", "uPlot.iife.min.js"), ("templates", "campaign.js"))


def write_campaign_report(
    file: str | Path,
    cell: Cell,
    output: str | Path,
    *,
    goal: Goal | None = None,
    now: str | None = None,
    posterior: str | Path | None = None,
    verification: str | Path | None = None,
    command: str = "",
) -> CampaignFacts:
    """Write the report of a campaign as one HTML file; the same input gives the same bytes.

    Parameters
    ----------
    file
        Campaign (HDF5) or CSV of measured sweeps; its first session calibrates.
    cell
        The cell that was measured.
    output
        The HTML file, replaced if it is there.
    goal
        What must be held; by default a circle of 100 um radius within 50 nm.
    now
        Time that the report is for: hours since the campaign began, or a clock time; by default this machine's clock
        where rows carry clock times, else the last session.
    posterior
        Draws of the calibration's posterior (.nc), or None.
    verification
        Result of ``fpcal verify`` of the calibration (.json), or None.
    command
        For the provenance.

    Returns
    -------
    CampaignFacts
        What the report says.

    Raises
    ------
    InputError
        If a file cannot be used, sessions overlap or repeat, a task that must be held is unknown, or the page cannot be
        written.
    """
    facts = gather(file, cell, goal=goal, now=now, posterior=posterior, verification=verification, command=command)
    write_text(Path(output), campaign_html(facts))
    return facts


def campaign_html(facts: CampaignFacts) -> str:
    """The page as text."""
    seen, drawn = facts.observability, facts.posterior
    track, outlook, rows = history(facts), outlooks(facts), residuals(facts)
    since = since_calibration(facts)
    told = [(each.prediction, each.numbers) for each in facts.tasks if each.prediction and each.numbers]
    at = words.shown_time(facts.now_h, facts)
    pictures = {
        "tasks": figures.task_figure(facts),
        "outlook": "" if outlook is None else figures.outlook_figure(facts, outlook),
        "drift": "" if track is None else figures.drift_figure(facts, track),
        "spectrum": observe_figures.spectrum_figure(seen),
        "contraction": observe_figures.contraction_figure(seen),
        "correlation": observe_figures.correlation_figure(seen),
        "residuals": figures.residual_figure(rows),
        "motions": figures.motion_figure(motion_curves(facts.calibration.estimate)),
        "posterior": ""
        if drawn is None
        else svg_panels(figures.prior_posterior_figure(drawn.parameters, drawn.draws, drawn.prior)),
    }
    charts = {
        "outlook": None if outlook is None else data.outlook_chart(facts, outlook),
        "residuals": data.residual_chart(rows),
    }
    return ENVIRONMENT.get_template("campaign.html").render(
        file=facts.file,
        cell=facts.cell,
        summary=f"{counted(len(facts.sweeps.sessions), 'session')}, {counted(len(facts.sweeps), 'row')}; as of {at}",
        about="" if facts.campaign is None else facts.campaign.about,
        style=Markup("\n".join([packaged("vendor", "uPlot.min.css"), packaged("templates", "campaign.css")])),
        scripts=Markup("\n".join(packaged(*file) for file in _SCRIPTS)),
        data=charts,
        verdict=words.verdict(facts),
        level=f"{100 * facts.goal.level:g} %",
        warnings=_warnings(facts),
        tasks=words.task_table(facts),
        # Along the beam what the page says of the task, which may be of the decision's draws.
        freedoms=freedom_table([each for each, _ in told], [numbers.most for _, numbers in told]),
        not_evaluated=not_evaluated_line(facts.cell),
        measured=words.measured_sentence(facts),
        sessions=words.session_table(facts),
        track_reason=facts.track_reason,
        since=words.since_tables(since),
        since_sentence=words.since_sentence(since),
        decision_reason=facts.decision_reason,
        log=log_table(facts),
        parameters=words.parameter_table(facts),
        headline=observe_words.headline(seen),
        gauges=[(observe_words.gauge_sentence(g), observe_words.gauge_direction(g, seen)) for g in seen.gauges],
        blocks=observe_words.block_table(seen),
        posterior=drawn and posterior_table(summarise(drawn), drawn.parameters, "Posterior of the calibration"),
        posterior_sentence=words.posterior_sentence(facts),
        verification=None if facts.verification is None else power_table(facts.verification, "Power by task"),
        verified=verification_sentences(facts.verification, facts.file),
        worst=words.residual_table(rows),
        budget=None if facts.budget is None else budget_table(facts.budget),
        budget_sentence=words.budget_sentence(facts),
        budget_reason=facts.budget_reason,
        mechanics=words.mechanics_table(facts.calibration.estimate),
        mechanics_sentence=words.mechanics_sentence(facts.calibration.estimate),
        provenance=words.provenance(facts),
        # Drawn here, and their texts escaped by the SVG writer.
        figures={name: Markup(svg) for name, svg in pictures.items()},
        **_next_sweeps(facts),
    )


def _warnings(facts: CampaignFacts) -> list[str]:
    """What speaks against trusting the page, each sentence once."""
    found = list(facts.observability.warnings)
    if facts.track is not None:
        found += [f"{o.session}: {w}" for o in facts.track.outcomes[1:] for w in (*o.evidence, *o.warnings)]
    if facts.verification is not None:
        found += [reason.text for reason in facts.verification.reasons]
    return list(dict.fromkeys(found))


def _next_sweeps(facts: CampaignFacts) -> dict[str, Any]:
    """The sweeps that are recommended now, if any."""
    decision = facts.decision
    if decision is None or decision.sweeps is None or decision.action == "hold":
        return {"next_sweeps": None}
    tasks = " ".join(f"--task {name}" for name in facts.goal.tasks)
    ticket = f"fpcal decide {facts.file} {tasks} --tolerance-nm {1e3 * facts.goal.tolerance_um:g} -o TICKET.csv"
    title = f"To be measured now, about {decision.minutes:.0f} min; the most useful first"
    return {"next_sweeps": sweep_table(decision.sweeps, facts.cell), "next_title": title, "next_command": ticket}
