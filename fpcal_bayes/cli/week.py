"""``fpcal week``: the whole protocol on the simulated cell."""

import argparse
import io
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from fpcal_bayes.cli.common import (
    Commands,
    add_command,
    cell_of,
    console,
    positive,
    seed,
    warm_up,
    warn,
)
from fpcal_bayes.files import make_folder, write_json, write_text
from fpcal_bayes.model.estimate import SCHEMA

if TYPE_CHECKING:
    from fpcal_bayes.infer.identify import Identification
    from fpcal_bayes.infer.posterior.sample import Posterior
    from fpcal_bayes.week import Week

_EPILOG = """\
Writes into DIR: campaign.h5 (sweeps, truth and estimates), an estimate JSON a session, report.txt (the paper's
Tables II to VII anew, beside the truth, and the posterior of day 0), posterior.nc (its draws), extrinsics.svg.
"""

#: Effective draws of the posterior of day 0.
_DRAWS = 1000


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "week", "run the paper's week on a simulated cell", run, _EPILOG)
    parser.add_argument(
        "-o", dest="output", metavar="DIR", type=Path, default=Path("week"), help="folder (default: week)"
    )
    parser.add_argument("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    parser.add_argument("--seed", type=seed, default=0, help="of the noise (default: 0)")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.infer.posterior.output import data_tree, write_netcdf
    from fpcal_bayes.infer.posterior.sample import sample
    from fpcal_bayes.measure.campaign import Campaign, write_campaign
    from fpcal_bayes.report.week_figure import draw_week, save_figure
    from fpcal_bayes.week import SESSIONS, Week, identify_session, measure_week

    cell = cell_of(options)
    folder: Path = options.output
    make_folder(folder)
    warm_up(cell)
    began = time.perf_counter()
    truth, sweeps = measure_week(cell, sigma=options.sigma_nm * 1e-3, seed=options.seed)

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
        if results[SESSIONS[0].name].converged:
            status.update(f"sampling the posterior of {SESSIONS[0].name}")
            posterior = sample(results[SESSIONS[0].name], draws=_DRAWS, seed=options.seed)
    week = Week(cell, truth, sweeps, results)

    contents = {name: {"schema": SCHEMA, "command": "identify", **r.content()} for name, r in results.items()}
    # A second run gives the same campaign: how long an identification took is in its own file.
    timeless = {name: content | {"fit": without_seconds(content["fit"])} for name, content in contents.items()}
    command = f"fpcal week --sigma-nm {options.sigma_nm:g} --seed {options.seed}"
    campaign = Campaign.of(sweeps, cell, command=command, seed=options.seed, truth=truth.record(), estimates=timeless)
    write_campaign(folder / "campaign.h5", campaign, cell)
    for name, content in contents.items():
        write_json(folder / f"{name}.json", content)
    save_figure(draw_week(week), folder / "extrinsics.svg")
    if posterior is not None:
        write_netcdf(data_tree(posterior, seed=options.seed, command=command), folder / "posterior.nc")
    text = io.StringIO()
    report = Console(file=text, width=120, highlight=False)
    print_week(week, report, timed=False)
    print_posterior(posterior, report)
    write_text(folder / "report.txt", text.getvalue())

    print_week(week, out)
    print_posterior(posterior, out)
    warn(f"{name}: {warning}" for name, result in results.items() for warning in result.warnings)
    out.print(
        f"{len(SESSIONS)} sessions, {len(sweeps)} sweeps in {time.perf_counter() - began:.1f} s -> {folder}/",
        markup=False,
        soft_wrap=True,
    )
    sampled = posterior is not None and posterior.converged
    return 0 if sampled and all(result.converged for result in results.values()) else 1


def without_seconds(fit: dict[str, Any]) -> dict[str, Any]:
    """What an estimate says about its fit, without the time it took."""
    return {key: value for key, value in fit.items() if key != "seconds"}


def print_week(week: "Week", out: Console, *, timed: bool = True) -> None:
    """Print each session's parameters beside the truth, as the paper's tables have them."""
    from fpcal_bayes.report.tables import fit_lines, reflection_lines, truth_table
    from fpcal_bayes.week import SESSIONS

    for session in SESSIONS:
        result = week.identifications[session.name]
        truth = week.truth.at(24.0 * session.day)
        names = week.truth.parameters.names
        shown = [i for i, name in enumerate(names) if session.free == "all" or name in result.free.names]
        held = "" if session.free == "all" else "; intrinsics held at day 2"
        title = f"Day {session.day:g}: {session.tables} of the paper anew{held}"
        out.print(truth_table(result.estimate, truth[shown], [names[i] for i in shown], title))
        for line in reflection_lines(result.estimate, week.truth.parameters, truth) + fit_lines(result, timed=timed):
            out.print(line, markup=False, soft_wrap=True)
        out.print()


def print_posterior(posterior: "Posterior | None", out: Console) -> None:
    """Print the posterior of day 0, or what it fails by."""
    from fpcal_bayes.report.posterior_tables import posterior_table

    if posterior is None:
        out.print("Posterior of day 0: not sampled, since its maximum was not found")
        return
    out.print(posterior_table(posterior, "Posterior of day 0"))
    for failure in posterior.failures:
        out.print(f"not converged: {failure}", markup=False, soft_wrap=True)
