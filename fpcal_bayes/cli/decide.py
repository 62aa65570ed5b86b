"""``fpcal decide``: whether to measure now, and what."""

import argparse
from pathlib import Path

from fpcal_bayes.analysis.campaign import follow
from fpcal_bayes.cli.control import warm_up_inverse
from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_goal,
    add_json,
    cell_of,
    check_output,
    console,
    count,
    goal_of,
    positive,
    warn,
    write_result,
)
from fpcal_bayes.core.errors import InputError

_EPILOG = """\
hold: nothing is to be measured before the time that is said; extrinsic: a few sweeps now, chosen to leave the least
error of the tasks; full: calibrate in full, since the robot itself moved or no few sweeps reach the tolerance.

The error of a task is what the controller does not know of the cavity length along its path, peak to peak. LEVEL is the
probability of being out of tolerance that is accepted before the next measurement; the share of time spent outside is
about a third of it. With --cost-out the level is the one at which measuring and errors together cost least.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "decide", "decide whether to measure now, and what", run, _EPILOG)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    add_goal(parser)
    parser.add_argument(
        "--now", metavar="TIME_H|UTC", help="time of the decision (default: this clock where rows carry utc, else the "
        "last session)"
    )  # fmt: skip
    parser.add_argument("--horizon-h", type=positive, default=24.0, help="how far to look ahead (default: 24)")
    parser.add_argument("--minutes-per-sweep", type=positive, default=2.0, help="default: 2")
    parser.add_argument("--minutes-per-session", type=positive, help="spent once a session (default: none)")
    parser.add_argument(
        "--cost-out", type=positive, metavar="MINUTES", help="of measuring that an hour out of tolerance is worth"
    )
    parser.add_argument("--most-sweeps", type=count, default=6, help="of a session with few sweeps (default: 6)")
    parser.add_argument(
        "--least-sweeps", type=count, default=1, help="of such a session: 2 for a circle whose drift sizes are not to "
        "be trusted (default: 1)"
    )  # fmt: skip
    parser.add_argument(
        "--diagnose-every-h", type=positive, default=24.0, metavar="H", help="longest time between two sessions that "
        "can show a change of the robot itself (default: 24)"
    )  # fmt: skip
    parser.add_argument("--sigma-nm", type=positive, help="of the sweeps to come (default: the campaign's median)")
    parser.add_argument("-o", dest="output", metavar="SWEEPS.csv", type=Path, help="write the sweeps as a plan")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    import numpy as np

    from fpcal_bayes.decision.decision import Costs
    from fpcal_bayes.decision.policy import decide_track, valid_until
    from fpcal_bayes.io.csv import write_csv
    from fpcal_bayes.report.track import (
        decision_content,
        decision_sentence,
        outlook_table,
        sweep_table,
        time_text,
        verdict_lines,
    )
    from fpcal_bayes.tracking.sessions import hours_now

    cell = cell_of(options)
    for output in (options.output, options.json):
        check_output(output, options.campaign, *(options.task or ()))
    if options.output is not None and options.output == options.json:
        raise InputError(f"{options.json}: expected two names for -o and --json")
    goal = goal_of(options)
    warm_up_inverse(cell)
    followed = follow(options.campaign, cell, now=options.now)
    found, sweeps = followed.track, followed.sweeps
    sigma = float(np.median(sweeps.sigma)) if options.sigma_nm is None else 1e-3 * options.sigma_nm
    costs = Costs(
        minutes_per_sweep=options.minutes_per_sweep,
        minutes_per_session=options.minutes_per_session or 0.0,
        out_of_tolerance=options.cost_out,
        least_sweeps=options.least_sweeps,
        most_sweeps=max(options.most_sweeps, options.least_sweeps),
        sigma=sigma,
        horizon_h=options.horizon_h,
        diagnosis_h=options.diagnose_every_h,
    )
    now_h = followed.now_h
    if now_h is None:
        now_h = hours_now(sweeps, found.last.time_h)
    decision = decide_track(found, sweeps, goal, costs, now_h)

    out = console(options)
    out.print(outlook_table(decision, goal, found))
    if decision.sweeps is not None and decision.action == "extrinsic":
        out.print(sweep_table(decision.sweeps, cell))
    out.print(decision_sentence(decision, found), markup=False, soft_wrap=True)
    warnings = verdict_lines(found) + followed.notes
    until_h = valid_until(found, goal)
    if now_h > until_h:
        until = time_text(until_h, found.outcomes)
        warnings.append(
            f"the estimate of session {found.last.session} was valid until {until}, {now_h - until_h:.1f} h ago"
        )
    warn(warnings)
    if options.output is not None and decision.sweeps is not None:
        write_csv(options.output, decision.sweeps, cell)
    content = {"decision": decision_content(decision, goal, found), "warnings": warnings}
    write_result(options.json, "decide", found.estimate().content() | content)
    return 0 if found.converged else 1
