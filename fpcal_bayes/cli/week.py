"""``fpcal week``: the whole protocol on the simulated cell."""

import argparse
import io
import time
from dataclasses import replace

from fpcal_bayes.cli.common import Output, console, warn
from fpcal_bayes.core.files import exclusive, make_folder, write_json, write_text
from fpcal_bayes.decision.policy import valid_until
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.posterior.netcdf import data_tree, summarise, write_netcdf
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.traces import write_path_trace
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA
from fpcal_bayes.report.campaign.page import write_campaign_report
from fpcal_bayes.report.fit import fit_lines
from fpcal_bayes.report.pages import save_figure
from fpcal_bayes.report.posterior import posterior_table
from fpcal_bayes.report.table import ANY_WIDTH
from fpcal_bayes.report.track import verdict_lines
from fpcal_bayes.report.week import circle_table, course_table, draw_courses, truth_table
from fpcal_bayes.study.paper_scenarios import Followed, follow_week
from fpcal_bayes.study.paper_week import (
    SESSIONS,
    Circle,
    Week,
    check_circles,
    identify_session,
    measure_week,
    renewed_circles,
)
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.record import record_of
from fpcal_bayes.tracking.tracker import Track

#: Effective draws of the posterior of day 0.
_DRAWS = 1000


def run(options: argparse.Namespace, cell: Cell) -> int:
    cell.require_one_beam("the paper's week")
    make_folder(options.output)
    with exclusive(options.output):
        return _run(options, cell)


def _run(options: argparse.Namespace, cell: Cell) -> int:
    warm_up_inverse(cell)
    began = time.perf_counter()
    sigma = options.sigma_nm * 1e-3
    truth, sweeps = measure_week(cell, sigma=sigma, seed=options.seed)

    out = console(options)
    results: dict[str, Identification] = {}
    full: Identification | None = None
    with out.status("identifying") as status:
        for session in SESSIONS:
            status.update(f"identifying {session.name} ({len(results) + 1} of {len(SESSIONS)})")
            results[session.name] = identify_session(cell, sweeps, session, full, {"file": "campaign.h5"})
            if session.free == "all":
                full = results[session.name]
        posterior = None
        first = SESSIONS[0].name
        if results[first].converged:
            status.update(f"sampling the posterior of {first}")
            posterior = sample(results[first], draws=_DRAWS, seed=options.seed)
        followed = follow_week(cell, truth, sweeps, results, sigma=sigma, seed=options.seed, progress=status.update)
        status.update("driving circles")
        checks = check_circles(cell, truth, first, results[first].estimate, options.seed)
        estimates = {name: result.estimate for name, result in results.items()}
        renewed = renewed_circles(cell, truth, estimates, options.seed + len(checks), options.seed)
    week = Week(cell, truth, sweeps, results)
    command = f"fpcal week --sigma-nm {options.sigma_nm:g} --seed {options.seed}"
    _write_data(options, week, followed, command)
    folder = options.output
    make_folder(folder / "circles")
    for circle in [*checks, *renewed]:
        write_path_trace(folder / "circles" / f"{circle.name}.csv", circle.trace, cell)
    save_figure(draw_courses(followed.courses), folder / "courses.svg")
    if posterior is not None:
        write_netcdf(data_tree(posterior, seed=options.seed, command=command), folder / "posterior.nc")
    if options.page:
        # As `fpcal report` writes it, for the tolerance that the policy holds.
        draws, goal = None if posterior is None else folder / "posterior.nc", followed.goal
        page = folder / "report.html"
        write_campaign_report(folder / "campaign.h5", cell, page, goal=goal, posterior=draws, command=command)
    text = io.StringIO()
    report = Output(file=text, width=ANY_WIDTH, highlight=False)
    for target, timed in ((report, False), (out, True)):
        _print_week(week, target, timed=timed)
        _print_courses(followed, checks, renewed, target)
        _print_posterior(posterior, target)
        if target is report:
            write_text(options.output / "report.txt", text.getvalue())
    warn(f"{name}: {warning}" for name, result in results.items() for warning in result.warnings)
    out.say(
        f"{len(SESSIONS)} sessions, {len(sweeps)} sweeps in {time.perf_counter() - began:.1f} s -> {options.output}/"
    )
    return 0 if posterior is not None and posterior.converged and all(r.converged for r in results.values()) else 1


def _write_data(options: argparse.Namespace, week: Week, followed: Followed, command: str) -> None:
    folder, cell = options.output, week.cell

    def save(file: str, sweeps: Sweeps, lived: Track) -> None:
        made = Campaign.of(sweeps, cell, command=command, seed=options.seed, truth=week.truth.record())
        write_campaign(folder / file, made, cell)
        # The track is of the rows as the file holds them, in degrees.
        stored = read_campaign(folder / file, cell).sweeps
        write_campaign(folder / file, replace(made, track=record_of(lived, stored, Limits())), cell)

    save("campaign.h5", week.sweeps, followed.track)
    lived = replace(followed.policy_track, data={"file": "policy.h5", "session": followed.policy_track.last.session})
    estimate = lived.estimate(valid_until(lived, followed.goal)).content() | {"fit": {"converged": lived.converged}}
    save("policy.h5", followed.policy_sweeps, lived)
    write_json(folder / "estimate.json", {"schema": SCHEMA, "command": "track", **estimate})
    for name, found in week.identifications.items():
        write_json(folder / f"{name}.json", {"schema": SCHEMA, "command": "identify", **found.content()})


def _print_week(week: Week, out: Output, *, timed: bool) -> None:
    for session in SESSIONS:
        result = week.identifications[session.name]
        truth = week.truth.at(24.0 * session.day)
        names = week.truth.parameters.names
        shown = [i for i, name in enumerate(names) if session.free == "all" or name in result.free.names]
        held = "" if session.free == "all" else "; intrinsics held at day 2"
        title = f"Day {session.day:g}: {session.tables} of the paper anew{held}"
        out.print(truth_table(result.estimate, truth[shown], [names[i] for i in shown], title))
        for line in fit_lines(result, timed=timed):
            out.say(line)
        out.print()


def _print_courses(followed: Followed, checks: list[Circle], renewed: list[Circle], out: Output) -> None:
    tolerance = followed.goal.tolerance_um
    out.print(circle_table("Circle with the estimate of day 0 (Fig 13)", checks, tolerance))
    out.print(circle_table("Circle at each identification (Fig 14)", renewed, tolerance))
    out.print(course_table(followed.courses))
    for name, lived in (("filter", followed.track), ("policy", followed.policy_track)):
        for line in verdict_lines(lived):
            out.say(f"{name}: {line}")
    out.print()


def _print_posterior(posterior: Posterior | None, out: Output) -> None:
    if posterior is None:
        out.print("Posterior of day 0: not sampled, since its maximum was not found")
        return
    out.print(posterior_table(summarise(posterior), posterior.identification.free, "Posterior of day 0"))
    for failure in posterior.failures:
        out.say(f"not converged: {failure}")
