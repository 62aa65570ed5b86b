"""``fpcal keep``: keep a cell calibrated, unattended."""

import argparse
from dataclasses import replace
from pathlib import Path

from fpcal_bayes.analysis.append import append
from fpcal_bayes.analysis.keep import Keeper, Outputs, Round
from fpcal_bayes.analysis.watch import watch
from fpcal_bayes.cli import measure
from fpcal_bayes.cli.common import console, warn
from fpcal_bayes.cli.driven import costs_of, goal_of
from fpcal_bayes.core.errors import HeldError, InputError
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.io.flat import FLAT_SUFFIXES
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.campaign.page import write_campaign_report
from fpcal_bayes.report.track import decision_sentence, time_text, verdict_lines
from fpcal_bayes.rig.clock import Clock
from fpcal_bayes.rig.reader import read_rig
from fpcal_bayes.rig.route import Guard
from fpcal_bayes.rig.settings import IDSDevice, Rig


def run(options: argparse.Namespace, cell: Cell) -> int:
    goal = goal_of(options, cell)
    require_suffix(options.flat, *FLAT_SUFFIXES)
    rig = None if options.rig is None else read_rig(options.rig, cell)
    if rig is not None and not isinstance(rig.instrument, IDSDevice):
        raise InputError(f"{options.rig}: keep needs an interferometer that reads lengths: traces are to be ingested")
    clock = Clock() if rig is None else rig.clock
    warm_up_inverse(cell)
    outputs = Outputs(options.estimate, options.ticket, options.flat)
    keeper = Keeper(options.campaign, cell, goal, lambda sweeps: costs_of(options, sweeps), outputs, clock.now)
    teller = _Teller(options)

    def take_in(_again: bool) -> None:
        try:
            found = keeper.round()
        except HeldError:
            raise
        except Exception:
            keeper.withdraw()
            raise
        if options.report is not None:
            write_campaign_report(options.campaign, cell, options.report, goal=goal, now=f"{found.now_h:.6f}")
        teller.tell(found)
        if rig is not None and found.ticket.plan is not None:
            _measure(options, cell, rig, found)

    if options.once:
        take_in(False)
        return 0
    often = clock.wall(60.0 * options.every_min)
    try:
        watch(options.campaign, options.look_s, take_in, lambda text: warn([text]), at_least=often)
    except (KeyboardInterrupt, SystemExit):
        return 0


def _measure(options: argparse.Namespace, cell: Cell, rig: Rig, found: Round) -> None:
    ticket = read_ticket(options.ticket, cell)
    assert ticket.plan is not None
    # A ticket that expired half measured has a session of the same name after it.
    stated = f"{ticket.plan.session[0]}_{ticket.name}"
    name = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in stated)
    campaign = Path(options.campaign)
    session = campaign.with_name(f"{campaign.stem}_{name}.h5")
    words = argparse.Namespace(**vars(options) | {"output": session})
    # An estimate that is not to be used does not end the loop: moves are then held to the cell's prior.
    track = found.followed.track
    guard = Guard(cell, rig, track.estimate() if track.lasting_trust.usable else None)
    agenda = measure.drive(words, cell, rig, guard, ticket, found.followed.sweeps)
    sweeps = agenda.sweeps()
    if agenda.left or sweeps is None:
        raise InputError(f"{session}: the ticket is not measured to its end")
    append(campaign, replace(sweeps, file=str(session)), cell, ticket=options.ticket, now=rig.clock.now())


class _Teller:
    """Says what is new since the last round."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._out = console(options)
        self._said: set[str] = set()

    def tell(self, found: Round) -> None:
        """Print a line for a decision that differs from the last, and warnings once."""
        track, last = found.followed.track, found.followed.track.last
        where = f"session {last.session}"
        if found.valid_until_h is not None:
            where += f", valid until {time_text(found.valid_until_h, track.outcomes)}"
        if found.decision is None:
            what = "no ticket"
        else:
            what = found.decision.action if found.ticket.plan is None else decision_sentence(found.decision, track)
        line = f"{where}: {what}"
        if line not in self._said:
            self._out.say(line)
        warn([text for text in (*verdict_lines(track), *found.notes) if text not in self._said])
        self._said = {line, *verdict_lines(track), *found.notes}
