"""Motion is held to the cell's envelope: which rows leave it, refused with what to do."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import home, joint_axes
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.joint_path import JointPath, in_turn, sweep_path, task_path
from fpcal_bayes.model.margin import SIGMAS, Known, margin, require_envelope

#: Without a measured gap a joint may move along the beam by this share of the nominal gap, to hold a task's plane.
_BLIND_SHARE = 0.01
#: A joint within this of the beam moves along it, as a cosine (60 deg).
_ALONG_BEAM = 0.5


@dataclass(frozen=True)
class Breach:
    """A row whose path leaves the envelope: its position, and a sentence with what to do."""

    row: int
    what: str


def breaches(
    model: CavityModel, draws: Floats, path: JointPath, *, exact: bool = False, rows: int | None = None
) -> list[Breach]:
    """Where a path leaves the cell's envelope, at most once a row and in the order of the rows.

    Parameters
    ----------
    model, draws, path, exact
        As in `margin`.
    rows
        How many rows the risk is shared by; by default those of the path.
    """
    envelope = require_envelope(model.cell)
    found = margin(model, draws, path, exact=exact, rows=len(np.unique(path.row)) if rows is None else rows)
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
    degrees = np.degrees(found.most_tilt)
    most = float(np.degrees(envelope.max_tilt))
    note(
        found.most_tilt > envelope.max_tilt,
        f"the mirror may tilt by {{}} deg at {SIGMAS:g} sd, max_tilt_deg = {most:g}: tilt less",
        degrees,
    )
    away = found.most_aside
    note(
        away > envelope.mirror_radius,
        f"the light may meet the mirror's plane {{}} um from its middle at {SIGMAS:g} sd, mirror_radius_um = "
        f"{envelope.mirror_radius:g}: move less across the beam",
        away,
    )
    rates = np.zeros(len(path.q))
    np.maximum.at(rates, path.step[:, 1], found.rate)
    fast = rates > envelope.max_fringe_rate
    note(
        fast,
        f"{{}} fringes a second, max_fringe_rate_hz = {envelope.max_fringe_rate:g}: state a lower speed of the joint",
        rates,
    )
    return [Breach(row, what) for row, what in sorted(seen.items())]


def within(model: CavityModel, draws: Floats, q_start: Floats, q_end: Floats, *, of: int = 1) -> Bools:
    """Whether each sweep (n_rows, n_joints) stays in the envelope, without the ways between them; shape (n_rows,).

    Parameters
    ----------
    of
        How many rows the plan will have that the sweeps are candidates of: they share the risk.
    """
    inside: Bools = np.ones(len(q_start), dtype=bool)
    if model.cell.envelope is None:
        return inside
    found = breaches(model, draws, sweep_path(model.cell, q_start, q_end, ways=False), rows=of)
    outside = {breach.row for breach in found}
    for row, moved in enumerate(q_start != q_end):
        inside[row] = row not in outside and not in_turn(model.cell, moved)
    return inside


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
    """Refuse sweeps (n_rows, n_joints), driven in their order, that may leave the cell's envelope on their whole path.

    Parameters
    ----------
    model, draws
        The cell and draws of what is known of it (`estimate_draws`, `prior_draws`).
    file, rows
        For the message: the source and the line of each row.
    exact
        As in `margin`.

    Raises
    ------
    InputError
        At the first such row, with what to do; nothing is refused where the cell has no envelope.
    """
    cell = model.cell
    if cell.envelope is None or not len(q_start):
        return
    for row, moved in enumerate(q_start != q_end):
        if in_turn(cell, moved):
            names = ", ".join(f"q{i + 1}" for i in np.flatnonzero(moved))
            what = (
                f"moves {names} at once, which [envelope] together does not allow: move them in turn, or name the group"
            )
            raise located(file, what, row=row + 1 if rows is None else rows[row])
    found = breaches(model, draws, sweep_path(cell, q_start, q_end), exact=exact)
    if found:
        row = found[0].row
        raise located(file, found[0].what, row=row + 1 if rows is None else rows[row])


def require_task_within_envelope(model: CavityModel, draws: Floats, q: Floats, *, name: str) -> None:
    """Refuse a task through joint vectors `q` (n_points, n_joints) that may leave the cell's envelope.

    Raises
    ------
    InputError
        At the first such point, with what to do; nothing is refused where the cell has no envelope.
    """
    if model.cell.envelope is None or not len(q):
        return
    found = breaches(model, draws, task_path(model.cell, q))
    if found:
        raise InputError(f"task {name!r}, point {found[0].row + 1}: {found[0].what}")


def require_in_front(model: CavityModel, values: Floats, path: JointPath, *, file: object, rows: Sequence[int]) -> None:
    """Refuse rows that no cell can give: the mirror stands behind the fibre, or turns its back to it, on the way.

    Parameters
    ----------
    values
        Free parameters, shape (n_free,): a truth or an estimate.
    """
    ahead, facing, _, _ = Known.of(model, values).facing(path.q)
    bad = ((facing[0] <= 0) | (ahead[0] <= 0)) & ~path.between
    if bad.any():
        worst = int(np.flatnonzero(bad)[0])
        length = ahead[0, worst] / facing[0, worst]
        what = f"the mirror stands behind the fibre on this sweep (L = {length:.4g} um): no cell gives such a length"
        raise located(file, what, row=int(rows[path.row[worst]]))


def no_envelope_text(cell: Cell) -> str | None:
    """One sentence for a cell without an envelope, or with one but no gap that a plan can start from, else None."""
    if cell.envelope is None:
        return f"cell {cell.name!r} states no [envelope]: nothing keeps the mirror off the fibre"
    return None


def _blind(model: CavityModel, draws: Floats, path: JointPath) -> list[tuple[int, str]]:
    """Rows that move along the beam while nobody knows the gap."""
    cell, vector = model.cell, model.vector(draws.mean(axis=0))
    directions, _ = joint_axes(cell, vector, home(cell))
    along = np.abs(directions @ chain.optical_axis(cell, vector)) > _ALONG_BEAM
    joints = np.flatnonzero(along & ~cell.revolute)
    ahead, facing, _, _ = Known.of(model, draws[0]).facing(home(cell)[None])
    most = _BLIND_SHARE * abs(float(ahead[0, 0] / facing[0, 0]))
    found = []
    for row in np.unique(path.row):
        mine = path.q[path.row == row][:, joints]
        far = np.abs(mine - home(cell)[joints]).max(axis=0, initial=0.0)
        if (far > most).any():
            name = f"q{joints[int(np.argmax(far))] + 1}"
            what = (
                f"moves {name} along the beam by {far.max():.4g} um while the gap is not known: measure it by a "
                "wavelength scan (a row of kind absolute), or state gap_um and gap_sd_um in [envelope]"
            )
            found.append((int(row), what))
    return found
