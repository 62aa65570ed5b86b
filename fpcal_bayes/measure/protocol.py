"""Which sweeps to measure: the paper's protocol, single sweeps, and which signs are known."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.resources import paper_tables
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sharing import Sharing
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.axes import joint_axes
from fpcal_bayes.model.cell.cell import Cell

#: Half the side of the cube of nodes, in um; the paper does not print it.
NODE_HALF_SIDE = 150.0

#: World axes along and about which the six joints move in the paper's chain: X 0, Y 1, Z 2.
_PAPER_AXES = (2, 1, 0, 0, 2, 1)
_PAPER_CHAIN = ("prismatic",) * 3 + ("revolute",) * 3

_MIDPOINT = "-mid"
#: The paper knows the sign of these sweeps from wavelength scans before and after them.
_SIGN_KNOWN = ("-tx", "-tz")


def paper_protocol(cell: Cell, *, midpoints: bool = False, session: str = "full-T0", time_h: float = 0.0) -> Sweeps:
    """The paper's protocol as a plan: 45 rotations at 15 nodes, then 24 translations at 8 orientations.

    Parameters
    ----------
    cell
        With the paper's chain: translations along Zw, Yw, Xw, then rotations about Xw, Zw, Yw.
    midpoints
        Read each sweep at its middle too: two rows, start to middle (label ends in ``-mid``) and start to end, in
        one group named after the sweep.
    session, time_h
        Time of all rows.

    Returns
    -------
    Sweeps
        69 rows, or 138 with midpoints.

    Raises
    ------
    InputError
        If the cell has another chain, or its limits do not let it make the sweeps.
    """
    _require_paper_chain(cell)
    labels, starts, ends = zip(*_paper_sweeps(), strict=True)
    q_start, q_end = np.array(starts) * cell.joint_scales, np.array(ends) * cell.joint_scales
    sweeps = Sweeps.of_um_rad(q_start, q_end, session=session, label=labels, time_h=time_h, file="protocol")
    if midpoints:
        sweeps = add_midpoints(sweeps)
    sweeps = seen_by_all(sweeps, cell)
    check_sweeps(sweeps, cell)
    return sweeps


def add_midpoints(sweeps: Sweeps) -> Sweeps:
    """A plan in which each row that stands alone becomes two: start to middle and start to end, in one group."""
    alone = (sweeps.group == "") & (sweeps.kind == "sweep")
    return read_often(sweeps, np.where(alone, 2, 1)) if alone.any() else sweeps


def read_often(sweeps: Sweeps, readings: int | Ints) -> Sweeps:
    """A plan in which each sweep is read at `readings` evenly spaced places after its start, one number or one a row.

    The rows of a sweep that is read more than once follow each other, in a group named after it. `InputError` if a
    sweep is read less than once, or one of a group more than once.
    """
    often = np.broadcast_to(readings, len(sweeps))
    bad = (often < 1) | ((often > 1) & ((sweeps.group != "") | (sweeps.kind != "sweep")))
    if bad.any():
        expected = "expected one at least, and one where rows stand in a group or are of another kind than sweep"
        i = int(np.argmax(bad))
        raise located(sweeps.file, f"{often[i]} readings: {expected}", row=int(sweeps.rows[i]), column="readings")
    if (often == 1).all():
        return sweeps
    labels, rows = sweeps.label.tolist(), sweeps.rows.tolist()
    # Two sweeps of one label do not share a start.
    sources = list(zip(sweeps.session.tolist(), labels, sweeps.beam.tolist(), strict=True))
    times = Counter(sources)
    names = np.array(
        [
            label if label and times[source] == 1 else f"{label} row {row}".lstrip()
            for source, label, row in zip(sources, labels, rows, strict=True)
        ]
    )
    order = np.repeat(np.arange(len(sweeps)), often)
    place = np.arange(len(order)) - np.repeat(np.cumsum(often) - often, often) + 1
    expanded, of = sweeps.take(order), often[order]
    share, still = (place / of)[:, None], expanded.q_start == expanded.q_end
    named = [
        label if i == n else f"{label}{_MIDPOINT}" if n == 2 else f"{label}-{i}/{n}"
        for label, i, n in zip(expanded.label.tolist(), place.tolist(), of.tolist(), strict=True)
    ]
    shots = [
        f"{shot} {i}/{n}" if shot and i < n else shot
        for shot, i, n in zip(expanded.shot.tolist(), place.tolist(), of.tolist(), strict=True)
    ]
    return replace(
        expanded,
        label=np.array(named, dtype=np.str_),
        shot=np.array(shots, dtype=np.str_),
        # A joint that stands still does so exactly: rounding is no motion.
        q_end=np.where(still, expanded.q_end, expanded.q_start * (1.0 - share) + expanded.q_end * share),
        group=np.where(of > 1, names[order], expanded.group),
    )


def seen_by_all(sweeps: Sweeps, cell: Cell) -> Sweeps:
    """A plan of a cell with several beams in which all of them read each row that names none, at one moment."""
    alone = sweeps.beam == ""
    if not cell.further or not alone.any():
        return sweeps
    order = np.repeat(np.arange(len(sweeps)), np.where(alone, len(cell.beams), 1))
    spread, alone = sweeps.take(order), alone[order]
    place = np.arange(len(order)) - np.searchsorted(order, order)
    taken, shots = Counter(sweeps.label.tolist()), []
    for i in order.tolist():
        label = str(sweeps.label[i])
        shots.append(label if label and taken[label] == 1 else f"{label} row {sweeps.rows[i]}".lstrip())
    return replace(
        spread,
        beam=np.where(alone, np.array(cell.beams)[place], spread.beam),
        shot=np.where(alone & (spread.shot == ""), np.array(shots), spread.shot),
    )


def motions_alone(sweeps: Sweeps) -> Sweeps:
    """What was driven, once whatever read it: `seen_by_all` turned round."""
    moments = np.unique(Sharing.of(sweeps).end)
    if len(moments) == len(sweeps):
        return sweeps
    driven, nothing = sweeps.take(moments), np.full(len(moments), "")
    return replace(driven, beam=nothing, shot=nothing)


def single_sweep(cell: Cell, joint: int, start: float, end: float, *, pose: Floats | None = None) -> Sweeps:
    """A plan of one sweep: joint number `joint` moves in um or rad, the others stand at `pose`, by default zero."""
    n_joints = len(cell.joints)
    if not 1 <= joint <= n_joints:
        raise InputError(f"joint {joint}: expected 1 to {n_joints}")
    q = np.zeros((2, n_joints)) if pose is None else np.tile(np.asarray(pose, dtype=float), (2, 1))
    q[:, joint - 1] = start, end
    sweeps = seen_by_all(Sweeps.of_um_rad(q[:1], q[1:], label=f"q{joint}", file="single sweep"), cell)
    check_sweeps(sweeps, cell)
    return sweeps


#: Protocols by the name a user gives.
PROTOCOLS: dict[str, Callable[[Cell], Sweeps]] = {
    "paper": paper_protocol,
    "paper-mid": lambda cell: paper_protocol(cell, midpoints=True),
}


def protocol_by_name(name: str, cell: Cell) -> Sweeps:
    """The protocol called `name` in `PROTOCOLS`, as a plan; `InputError` if none is or the cell cannot make it."""
    if name not in PROTOCOLS:
        raise InputError(f"unknown protocol {name!r}: expected one of {', '.join(PROTOCOLS)} or a sweep file")
    return PROTOCOLS[name](cell)


def mark_signs(sweeps: Sweeps, signs: str) -> Sweeps:
    """Mark which rows know the sign of their change of length; others get its size. A lost sign stays lost.

    signs: ``all``, or ``paper``: only X and Z translations (labels in ``-tx``, ``-tz``) and absolute lengths.
    """
    if signs not in ("all", "paper"):
        raise InputError(f"unknown signs {signs!r}: expected all or paper")
    known = np.ones(len(sweeps), dtype=bool)
    if signs == "paper":
        labels = [label.removesuffix(_MIDPOINT) for label in sweeps.label.tolist()]
        known = np.array([label.endswith(_SIGN_KNOWN) for label in labels]) | sweeps.absolute
    known &= sweeps.signed | np.isnan(sweeps.dl)
    return replace(sweeps, signed=known, dl=np.where(known, sweeps.dl, np.abs(sweeps.dl)))


def _paper_sweeps() -> Iterator[tuple[str, list[float], list[float]]]:
    """Label, start and end of each sweep, in um and deg."""
    setup = paper_tables()["setup"]
    tilt, spin = setup["tilt_sweep_deg"], setup["spin_sweep_deg"]
    rotations = {"rx": (3, tilt), "rz": (4, tilt), "ry": (5, spin)}
    across, along = setup["translation_sweep_xz_um"], setup["translation_sweep_y_um"]
    translations = {"tx": (2, across), "ty": (1, along), "tz": (0, across)}

    def moves(name: str, pose: list[float], swept: dict[str, tuple[int, list[float]]]):  # type: ignore[no-untyped-def]
        for suffix, (joint, (low, high)) in swept.items():
            start, end = pose.copy(), pose.copy()
            start[joint], end[joint] = low, high
            yield f"{name}-{suffix}", start, end

    # q1, q2, q3 at the centre, the corners and the face centres of a cube.
    half = NODE_HALF_SIDE
    corners = [[q1, q2, q3] for q3, q2, q1 in product((-half, half), repeat=3)]
    faces = [[side if joint == moved else 0.0 for joint in range(3)] for side in (-half, half) for moved in (2, 1, 0)]
    for number, node in enumerate([[0.0, 0.0, 0.0], *corners, *faces]):
        yield from moves(f"node{number}", [*node, 0.0, 0.0, 0.0], rotations)
    for q4, q5, q6 in product((0.0, tilt[1]), (0.0, tilt[1]), spin):
        yield from moves(f"orient{q4:g}-{q5:g}-{q6:g}", [0.0, 0.0, 0.0, q4, q5, q6], translations)


def _require_paper_chain(cell: Cell) -> None:
    fits = tuple(joint.kind for joint in cell.joints) == _PAPER_CHAIN
    if fits:
        # Joints move along or about the world's axes, within 10 degrees.
        directions, _ = joint_axes(cell, cell.parameters.nominal, np.zeros(len(cell.joints)))
        fits = bool((directions[range(len(_PAPER_AXES)), _PAPER_AXES] > np.cos(np.radians(10.0))).all())
    if not fits:
        raise InputError(
            f"cell {cell.name!r}: the paper's protocol is for a chain that moves along Zw, Yw, Xw, then turns about "
            "Xw, Zw, Yw; give a sweep file instead"
        )
