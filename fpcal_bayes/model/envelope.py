"""Motion is held to the cell's envelope: which rows leave it, refused with what to do."""

from collections.abc import Sequence

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import home, joint_axes
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.joint_path import JointPath, in_turn, lattice, sweep_path, task_path
from fpcal_bayes.model.margin import SIGMAS, Known, gap_is_known, margin, require_envelope

#: Without a measured gap a joint may move along the beam by this share of the nominal gap, to hold a task's plane.
_BLIND_SHARE = 0.01
_MEASURE_GAP = "measure it by a wavelength scan (a row of kind absolute), or state gap_um and gap_sd_um in [envelope]"
#: A joint within this of the beam moves along it, as a cosine (60 deg).
_ALONG_BEAM = 0.5
#: Standard deviations by which a length is below zero that no cell can have given.
_LIKELY = 2.0
_TOUCHING_UM = 1e-6
#: Lengths of one pose that are known better than this, in um, say no more together than one of them.
_LEAST_SD = 1e-4
#: Share of a joint's range that gives way at a time.
_CUT = 0.02
#: Draws that ranges are found with, and rows that share the risk: a plan has fewer, and is looked at again as a whole.
_FEW, _ROWS = 400, 100


def breaches(
    model: CavityModel, draws: Floats, path: JointPath, *, exact: bool = False, rows: int | None = None
) -> dict[int, str]:
    """Where a path leaves the cell's envelope: rows in their order, each with what to do; arguments as in `margin`."""
    envelope = require_envelope(model.cell)
    rows = len(np.unique(path.row)) if rows is None else rows
    found = margin(model, draws, path, exact=exact, rows=rows, boxes=True)
    seen: dict[int, str] = {}

    def note(poses: Bools, text: str, shown: Floats, *, least: bool = False) -> None:
        for row in np.unique(path.row[poses]):
            mine = np.flatnonzero(poses & (path.row == row))
            worst = int(mine[np.argmin(shown[mine])] if least else mine[np.argmax(shown[mine])])
            way = "on the way to its start " if path.between[worst] else ""
            spread = f" (expected {found.gap[worst]:.4g}, sd {found.gap_sd[worst]:.2g})" if least else ""
            seen.setdefault(int(row), way + text.format(f"{shown[worst]:.4g}{spread}"))

    if found.known:
        note(
            found.least_gap < envelope.least_gap,
            f"the mirror comes to {{}} um from the fibre at {SIGMAS:g} sd, least_gap_um = {envelope.least_gap:g}: move "
            "less towards the fibre, tilt less, or know the gap better (a wavelength scan, kind = absolute)",
            found.least_gap,
            least=True,
        )
    else:
        for row, text in _blind(model, draws, path):
            seen.setdefault(row, text)
    most = np.degrees(envelope.max_tilt)
    tilted = f"the mirror may tilt by {{}} deg at {SIGMAS:g} sd, max_tilt_deg = {most:g}: tilt less"
    note(found.most_tilt > envelope.max_tilt, tilted, np.degrees(found.most_tilt))
    aside = (
        f"the light may meet the mirror's plane {{}} um from its middle at {SIGMAS:g} sd, mirror_radius_um = "
        f"{envelope.mirror_radius:g}: move less across the beam"
    )
    note(found.most_aside > envelope.mirror_radius, aside, found.most_aside)
    rates, fastest = np.zeros(len(path.q)), envelope.max_fringe_rate
    np.maximum.at(rates, path.step[:, 1], found.rate)
    fast = f"{{}} fringes a second, max_fringe_rate_hz = {fastest:g}: state a lower speed of the joint"
    note(rates > fastest, fast, rates)
    return dict(sorted(seen.items()))


def safe_ranges(model: CavityModel, draws: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Ranges of the joints within `low` to `high` (n_joints,) in which every pose and way stays in the envelope.

    The joint gives way whose return to zero helps the worst pose most; `InputError` if zero itself may be outside.
    """
    cell, at = model.cell, home(model.cell)
    if cell.envelope is None:
        return low, high
    envelope, low, high = cell.envelope, low.copy(), high.copy()
    width = high - low
    along, most = (np.zeros(0, dtype=int), 0.0) if gap_is_known(model, draws) else _along_beam(model, draws)
    low[along], high[along] = np.maximum(low[along], at[along] - most), np.minimum(high[along], at[along] + most)

    few = draws[:_FEW]

    def excess(q: Floats) -> Floats:
        found = margin(model, few, _poses(q), rows=_ROWS)
        near = 1.0 - found.least_gap / envelope.least_gap if found.known else np.full(len(q), -np.inf)
        tilted, aside = found.most_tilt / envelope.max_tilt, found.most_aside / envelope.mirror_radius
        return np.asarray(np.maximum(near, np.maximum(tilted, aside) - 1.0))

    if excess(at[None])[0] > 0:
        raise InputError(f"cell {cell.name!r} at joint zero: {breaches(model, draws, _poses(at[None]), rows=_ROWS)[0]}")
    while True:
        box = lattice(cell, low, high)[0]
        over = excess(box)
        worst = int(np.argmax(over))
        if over[worst] <= 0:
            return low, high
        pose = box[worst]
        away = pose != at
        # A little of the way to joint zero; or where that gains nothing all of it, also of a joint inside its range.
        for reach, able in ((_CUT * width, away & ((pose == low) | (pose == high))), (width, away)):
            back, step = np.tile(pose, (len(pose), 1)), np.minimum(reach, np.abs(pose - at))
            np.fill_diagonal(back, pose - np.sign(pose - at) * step)
            gains = np.where(able, (over[worst] - excess(back)) / np.where(able, step, 1.0) * width, -np.inf)
            if gains.max() > 0:
                break
        joint = int(np.argmax(gains))
        # As far as the slope says, but in steps, for other poses and joints may come to matter more.
        far = width[joint] * np.clip(over[worst] / max(gains[joint], 1e-9), _CUT / 4.0, 4.0 * _CUT)
        side = high if pose[joint] > at[joint] else low
        side[joint] = pose[joint] - np.sign(pose[joint] - at[joint]) * min(far, abs(pose[joint] - at[joint]))


def _poses(q: Floats) -> JointPath:
    n = len(q)
    return JointPath(q, np.arange(n), np.zeros(n, dtype=bool), np.zeros((0, 2), dtype=np.int64), np.zeros(0))


def require_within_envelope(
    model: CavityModel,
    draws: Floats,
    q_start: Floats,
    q_end: Floats,
    *,
    file: object,
    rows: Sequence[int] | None = None,
    exact: bool = False,
) -> None:
    """Refuse sweeps (n_rows, n_joints), at lines `rows`, that may leave the envelope; others as in `margin`."""
    cell = model.cell
    if cell.envelope is None or not len(q_start):
        return
    for row, moved in enumerate(q_start != q_end):
        if in_turn(cell, moved):
            names = ", ".join(f"q{i + 1}" for i in np.flatnonzero(moved))
            what = (
                f"moves {names} at once, which [envelope] together does not allow: move one by one, or name the group"
            )
            raise located(file, what, row=row + 1 if rows is None else rows[row])
    for row, what in breaches(model, draws, sweep_path(cell, q_start, q_end), exact=exact).items():
        raise located(file, what, row=row + 1 if rows is None else rows[row])


def require_task_within_envelope(
    model: CavityModel, draws: Floats, q: Floats, *, name: str, start: Floats | None = None, exact: bool = False
) -> None:
    """Refuse a task through `q` (n_points, n_joints), from `start` or joint zero, that may leave the envelope."""
    if model.cell.envelope is None or not len(q):
        return
    for row, what in breaches(model, draws, task_path(model.cell, q, start), exact=exact).items():
        raise InputError(f"task {name!r}, point {row + 1}: {what}")


def require_in_front(model: CavityModel, values: Floats, path: JointPath, *, file: object, rows: Sequence[int]) -> None:
    """Refuse rows that no cell with these parameters gives: the mirror stands behind the fibre or faces away."""
    ahead, facing, _, _ = Known.of(model, values).facing(path.q)
    bad = ((facing[0] <= 0) | (ahead[0] <= 0)) & ~path.between
    if bad.any():
        worst = int(np.flatnonzero(bad)[0])
        length = ahead[0, worst] / facing[0, worst]
        what = f"the mirror stands behind the fibre on this sweep (L = {length:.4g} um): no cell gives such a length"
        raise located(file, what, row=int(rows[path.row[worst]]))


def behind_the_fibre(cell: Cell, q: Floats, seen: tuple[Floats, Floats, Floats]) -> tuple[Bools, Floats]:
    """Poses at which the mirror is behind the fibre whatever is likely, and lengths; `seen`: poses, lengths, sd."""
    model, at = CavityModel.of(cell.with_opd("axis")), home(cell)[None]
    gap = () if cell.envelope is None or cell.envelope.gap is None else (cell.envelope.gap, cell.envelope.gap_sd or 0.0)
    stated = np.array(gap).reshape(-1, 2)
    poses = np.vstack([q, seen[0], at[: len(stated)]])
    lengths, jacobian = model.predict_with_jacobian(model.free.nominal, model.pose_rows(poses))
    rows = jacobian * model.free.prior_sd
    n = len(q)
    # What the prior leaves of the lengths, given those that are known.
    noise = np.diag(np.maximum(np.concatenate([seen[2], stated[:, 1]]), _LEAST_SD) ** 2)
    gain = np.linalg.solve(rows[n:] @ rows[n:].T + noise, rows[n:] @ rows[:n].T).T
    expected = lengths[:n] + gain @ (np.concatenate([seen[1], stated[:, 0]]) - lengths[n:])
    variance = (rows[:n] ** 2).sum(axis=1) - (gain * (rows[:n] @ rows[n:].T)).sum(axis=1)
    _, facing, _, _ = Known.of(model, model.free.nominal).facing(q)
    # A mirror that touches the fibre is not behind it, whatever rounding says.
    behind = (expected < -_LIKELY * np.sqrt(np.maximum(variance, 0.0)) - _TOUCHING_UM) | (facing[0] <= 0)
    # The literal reading of the paper has the light run along the mirror.
    return behind & (cell.optical_axis != "z"), expected


def no_envelope_text(model: CavityModel, draws: Floats) -> list[str]:
    """A sentence for a cell without an envelope, or with one but no gap that draws could tell."""
    name = repr(model.cell.name)
    if model.cell.envelope is None:
        return [f"cell {name} states no [envelope]: nothing keeps the mirror off the fibre"]
    if gap_is_known(model, draws):
        return []
    return [f"cell {name}: the gap is not known, so that nothing moves along the beam: {_MEASURE_GAP}"]


def _along_beam(model: CavityModel, draws: Floats) -> tuple[Ints, float]:
    """Joints that move along the beam, and how far each may while nobody knows the gap."""
    cell, mean = model.cell, draws.mean(axis=0)
    vector = model.vector(mean)
    directions, _ = joint_axes(cell, vector, home(cell))
    along = np.abs(directions @ chain.optical_axis(cell, vector)) > _ALONG_BEAM
    ahead, facing, _, _ = Known.of(model, mean).facing(home(cell)[None])
    return np.flatnonzero(along & ~cell.revolute), _BLIND_SHARE * abs(float(ahead[0, 0] / facing[0, 0]))


def _blind(model: CavityModel, draws: Floats, path: JointPath) -> list[tuple[int, str]]:
    """Rows that move along the beam while nobody knows the gap."""
    cell = model.cell
    joints, most = _along_beam(model, draws)
    found = []
    for row in np.unique(path.row):
        far = np.abs(path.q[path.row == row][:, joints] - home(cell)[joints]).max(axis=0, initial=0.0)
        if (far > most).any():
            name = f"q{joints[int(np.argmax(far))] + 1}"
            what = f"moves {name} along the beam by {far.max():.4g} um while the gap is not known: {_MEASURE_GAP}"
            found.append((int(row), what))
    return found
