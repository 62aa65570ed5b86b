"""What was measured, as a session: rows, recordings, and what is in doubt."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.times import iso
from fpcal_bayes.io.traces import read_trace
from fpcal_bayes.measure.campaign import DoubtfulRecord
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Order
from fpcal_bayes.model.cell.cell import Cell


def sweeps_of(
    orders: Sequence[Order], outcomes: Mapping[int, Mapping[str, Any]], *, sigma: float, origin_s: float
) -> Sweeps | None:
    """Rows of the orders that gave reliable numbers, or None; `sigma` in um, `origin_s` the campaign's Unix time."""
    rows: list[dict[str, Any]] = []
    for number, outcome in outcomes.items():
        if outcome["doubt"]:
            continue
        order, (first, *others) = orders[number], outcome["readings"]
        start, before, side = np.array(first["q"]), order.start, np.zeros(order.start.shape, dtype=int)
        for label, target, reading in zip(order.labels, order.targets, others, strict=True):
            side = np.where(target != before, np.sign(target - before), side).astype(int)
            before = target
            # A joint that was not sent anywhere stands where it stood, whatever its encoder shows.
            end = np.where(target != order.start, np.array(reading["q"]), start)
            celsius = reading["temperature_c"]
            rows.append(
                {
                    "session": order.session,
                    "label": label,
                    "time_h": (reading["moment_s"] - origin_s) / 3600.0,
                    "q_start": start,
                    "q_end": end,
                    "dl": reading["length_um"] - first["length_um"],
                    "group": order.group,
                    "utc": iso(reading["moment_s"]),
                    "temperature_c": np.nan if celsius is None else celsius,
                    "t_start_h": (first["moment_s"] - origin_s) / 3600.0,
                    "approach": "".join("-0+"[sign + 1] for sign in side.tolist()),
                }
            )
    if not rows:
        return None
    table: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    q_start, q_end = np.array(table.pop("q_start")), np.array(table.pop("q_end"))
    for name in ("time_h", "dl", "temperature_c", "t_start_h"):
        table[name] = np.array(table[name], dtype=float)
    return Sweeps.of_um_rad(q_start, q_end, sigma=sigma, file="session", t_end_h=table["time_h"], **table)


def doubtful_of(orders: Sequence[Order], outcomes: Mapping[int, Mapping[str, Any]]) -> DoubtfulRecord | None:
    """The orders that gave no reliable number; None if there is none."""
    doubtful = [number for number, outcome in sorted(outcomes.items()) if outcome["doubt"]]
    if not doubtful:
        return None
    n = len(doubtful)
    return DoubtfulRecord(
        session=np.array([orders[number].session for number in doubtful], dtype=np.str_),
        label=np.array([orders[number].label for number in doubtful], dtype=np.str_),
        reason=np.array([outcomes[number]["doubt"] for number in doubtful], dtype=np.str_),
        recording=np.array(doubtful, dtype=np.int64),
        dl=np.full(n, np.nan),
        sigma=np.full(n, np.nan),
        signed=np.ones(n, dtype=bool),
        alternatives=((),) * n,
    )


def recordings_of(
    orders: Sequence[Order], outcomes: Mapping[int, Mapping[str, Any]], cell: Cell, folder: Path, origin_s: float
) -> TraceIndex | None:
    """The recorded traces of all orders; None if there is none."""
    kept = [(orders[number], outcome) for number, outcome in outcomes.items() if not outcome["doubt"]]
    if not kept:
        return None
    ends = [np.array([outcome["readings"][end]["q"] for _, outcome in kept]) for end in (0, -1)]
    moved = np.array([order.start != order.targets[-1] for order, _ in kept])
    moments = [outcome["readings"][-1]["moment_s"] for _, outcome in kept]
    scales = cell.joint_scales[moved.argmax(axis=1)]
    traces = [read_trace(folder / outcome["trace"], float(s)) for (_, outcome), s in zip(kept, scales, strict=True)]
    sweeps = Sweeps.of_um_rad(
        ends[0],
        np.where(moved, ends[1], ends[0]),
        session=[order.session for order, _ in kept],
        label=[order.label for order, _ in kept],
        time_h=(np.array(moments) - origin_s) / 3600.0,
        utc=[iso(moment) for moment in moments],
        file="session",
    )
    return TraceIndex.of(sweeps, traces)
