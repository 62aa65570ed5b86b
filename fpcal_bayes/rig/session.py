"""Measure a ticket: drive its orders until all are done, or stop all axes and keep what was measured."""

from collections.abc import Callable
from dataclasses import dataclass

from fpcal_bayes.rig.agenda import Agenda
from fpcal_bayes.rig.bench import Bench
from fpcal_bayes.rig.route import Guard, dry_run, total_seconds


@dataclass(frozen=True)
class Progress:
    """How far a session is."""

    done: int  # orders
    total: int
    label: str  # of the order driven last
    doubt: str  # about it; empty if there is none
    left_s: float  # seconds of the cell that the rest will take


@dataclass(frozen=True)
class Summary:
    """How a session ended."""

    rows: int  # rows, or traces, in the session's file
    done: int  # orders driven
    total: int
    doubtful: int  # orders without a reliable number
    reason: str  # why it ended


class Failed(Exception):
    """A session ended before its time: `__cause__` says why, `unsure` which controllers may still move, a line each."""

    def __init__(self, summary: Summary, unsure: list[str]) -> None:
        super().__init__(summary.reason)
        self.summary = summary
        self.unsure = unsure


def measure(agenda: Agenda, bench: Bench, guard: Guard, tell: Callable[[Progress], None]) -> Summary:
    """Drive all orders that are left; `Failed` if a device is lost, a move is forbidden, or all must stop.

    Every move is looked at before the first is made. Whatever goes wrong, the axes are stopped before all else.
    """
    if not agenda.left:
        return _summary(agenda, agenda.should_stop()[1])
    try:
        bench.prepare()
        legs = dry_run(guard, [agenda.orders[number] for number in agenda.left], bench.position())
        agenda.begin()
        bench.before = agenda.last
        expected, began, planned = total_seconds(legs), agenda.rig.clock.ticks(), 0.0
        durations = dict(zip(agenda.left, (total_seconds([order]) for order in legs), strict=True))
        while not agenda.should_stop()[0]:
            for point in agenda.suggest(1):
                number = int(point["_id"])
                outcome = bench.drive(number, agenda.orders[number])
                agenda.ingest([outcome])
                planned += durations[number]
                pace = (agenda.rig.clock.ticks() - began) / planned if planned > 0.0 else 1.0
                done = len(agenda.outcomes)
                left = (expected - planned) * pace
                tell(Progress(done, len(agenda.orders), str(point["label"]), str(outcome["doubt"]), left))
    except BaseException as error:
        unsure = bench.stop()
        if not isinstance(error, Exception):
            agenda.checkpoint()
            raise
        raise Failed(_summary(agenda, str(error)), unsure) from error
    finally:
        bench.close()
    return _summary(agenda, agenda.should_stop()[1])


def _summary(agenda: Agenda, reason: str) -> Summary:
    rows = agenda.checkpoint()
    doubtful = sum(bool(outcome["doubt"]) for outcome in agenda.outcomes.values())
    return Summary(rows, len(agenda.outcomes), len(agenda.orders), doubtful, reason)
