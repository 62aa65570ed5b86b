"""How near the mirror comes to the fibre along a path, with what is known of the cell, held to the cell's envelope.

Changes of length never see the gap itself, so it comes from the cell (``gap_um``), or from an estimate that holds a
measured length. Mirror and fibre are discs: the fibre's edge stands before the mirror's plane, or the mirror's edge
before the plane of the fibre's end; whichever keeps them farther apart counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import home, joint_axes
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.envelope import Envelope
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.joint_path import JointPath, in_turn, sweep_path, task_path

#: Standard deviations of the estimate that stay inside the envelope.
SIGMAS = 4.0
#: Draws of an estimate that its uncertainty is judged by.
N_DRAWS = 400
#: An estimate whose length at joint zero is known this much better than the prior says has measured it.
_MEASURED = 0.5
#: Without a measured gap a joint may move along the beam by this share of the nominal gap, to hold a task's plane.
_BLIND_SHARE = 0.01
#: A joint within this of the beam moves along it, as a cosine (60 deg).
_ALONG_BEAM = 0.5
#: Stands for a clearance where the mirror faces away.
_AWAY = -1e6
#: Draws times poses that are looked at together: what fits a few tens of megabytes.
_BLOCK = 400_000


@dataclass(frozen=True)
class Margin:
    """What is left at each pose; lengths in um, angles in rad.

    Attributes
    ----------
    gap, gap_sd
        Clearance between mirror and fibre, edges included, expected and its standard deviation, shape (n_poses,).
    tilt, tilt_sd
        Angle between light and mirror normal, likewise.
    aside, aside_sd
        Distance of the reflection point from the mirror's origin, likewise.
    rate
        Half waves a second on each step of the path at `SIGMAS` standard deviations, shape (n_steps,).
    known
        Whether the gap is measured; if not, `gap` counts from the nominal one.
    """

    gap: Floats
    gap_sd: Floats
    tilt: Floats
    tilt_sd: Floats
    aside: Floats
    aside_sd: Floats
    rate: Floats
    known: bool

    @property
    def least_gap(self) -> Floats:
        """Clearance at `SIGMAS` standard deviations, shape (n_poses,)."""
        return self.gap - SIGMAS * self.gap_sd

    @property
    def most_tilt(self) -> Floats:
        """Tilt at `SIGMAS` standard deviations, shape (n_poses,)."""
        return self.tilt + SIGMAS * self.tilt_sd


@dataclass(frozen=True)
class Breach:
    """A row whose path leaves the envelope: its position, and a sentence with what to do."""

    row: int
    what: str


def estimate_draws(estimate: Estimate, n: int = N_DRAWS, seed: int = 0) -> tuple[CavityModel, Floats]:
    """The model of an estimate's parameters and draws of them, shape (n, n_free), from its covariance."""
    model = CavityModel.of(estimate.cell, estimate.parameters, estimate.vector())
    values, vectors = np.linalg.eigh(estimate.covariance)
    spread = np.random.default_rng(seed).standard_normal((n, len(values))) * np.sqrt(np.clip(values, 0.0, None))
    return model, estimate.values + spread @ vectors.T


def prior_draws(cell: Cell, n: int = N_DRAWS, seed: int = 0) -> tuple[CavityModel, Floats]:
    """The model of a cell's free parameters and draws of their priors, as normal ones, shape (n, n_free)."""
    free = cell.free
    return CavityModel.of(cell), free.nominal + free.prior_sd * np.random.default_rng(seed).standard_normal(
        (n, len(free))
    )


def margin(model: CavityModel, draws: Floats, path: JointPath, *, exact: bool = False) -> Margin:
    """What a path leaves between mirror and fibre.

    Parameters
    ----------
    model, draws
        A cell with an envelope, and draws of the model's free parameters, shape (n_draws, n_free).
    exact
        The draws know the gap, as a simulated truth does: the cell's own `gap_um` is not looked at.

    Raises
    ------
    InputError
        If the cell has no envelope, or the gap that it states and the one that the draws have measured disagree.
    """
    envelope = require_envelope(model.cell)
    draws = np.atleast_2d(draws)
    known = (np.zeros(len(draws)), 0.0) if exact else _gap(model, draws, envelope)
    shift, gap_sd = (np.zeros(len(draws)), 0.0) if known is None else known
    sizes = np.empty((6, len(path.q)))
    step = max(1, _BLOCK // len(draws))
    for first in range(0, len(path.q), step):
        block = slice(first, first + step)
        ahead, facing, aside, before = _facing(model, draws, path.q[block])
        tilt = np.arccos(np.clip(facing, -1.0, 1.0))
        lean = np.sin(np.minimum(tilt, np.pi / 2))
        from_plane = ahead + shift[:, None] * facing - envelope.fibre_radius * lean
        from_face = before + shift[:, None] - envelope.mirror_radius * lean
        clear = np.where(facing > 0.1, np.maximum(from_plane, from_face), _AWAY)
        for i, size in enumerate((clear, tilt, aside)):
            sizes[2 * i, block], sizes[2 * i + 1, block] = size.mean(axis=0), size.std(axis=0)
    sizes[1] = np.hypot(sizes[1], gap_sd)
    gap, spread, tilt_mean, tilt_sd, aside_mean, aside_sd = sizes
    rates = _rates(model, draws, path)
    return Margin(gap, spread, tilt_mean, tilt_sd, aside_mean, aside_sd, rates, known is not None)


def breaches(model: CavityModel, draws: Floats, path: JointPath, *, exact: bool = False) -> list[Breach]:
    """Where a path leaves the cell's envelope, at most once a row and in the order of the rows."""
    envelope = require_envelope(model.cell)
    found = margin(model, draws, path, exact=exact)
    seen: dict[int, str] = {}

    def note(poses: Bools, text: str, shown: Floats, sd: Floats | None = None) -> None:
        for row in np.unique(path.row[poses]):
            mine = np.flatnonzero(poses & (path.row == row))
            worst = int(mine[np.argmax(np.abs(shown[mine]))] if sd is None else mine[np.argmin(shown[mine])])
            way = "on the way to its start " if path.between[worst] else ""
            spread = "" if sd is None else f" (expected {shown[worst] + SIGMAS * sd[worst]:.4g}, sd {sd[worst]:.2g})"
            seen.setdefault(int(row), way + text.format(f"{shown[worst]:.4g}{spread}"))

    if found.known:
        note(
            found.least_gap < envelope.least_gap,
            f"the mirror comes to {{}} um from the fibre at {SIGMAS:g} sd, least_gap_um = {envelope.least_gap:g}: move "
            "less towards the fibre, tilt less, or know the gap better (a wavelength scan, kind = absolute)",
            found.least_gap,
            found.gap_sd,
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
    away = found.aside + SIGMAS * found.aside_sd
    note(
        away > envelope.mirror_radius,
        f"the light may meet the mirror's plane {{}} um from its middle at {SIGMAS:g} sd, mirror_radius_um = "
        f"{envelope.mirror_radius:g}: move less across the beam",
        away,
    )
    fast = np.zeros(len(path.q), dtype=bool)
    rates = np.zeros(len(path.q))
    np.maximum.at(rates, path.step[:, 1], found.rate)
    fast = rates > envelope.max_fringe_rate
    note(
        fast,
        f"{{}} fringes a second, max_fringe_rate_hz = {envelope.max_fringe_rate:g}: state a lower speed of the joint",
        rates,
    )
    return [Breach(row, what) for row, what in sorted(seen.items())]


def within(model: CavityModel, draws: Floats, q_start: Floats, q_end: Floats) -> Bools:
    """Whether each sweep (n_rows, n_joints) stays in the envelope, without the ways between them; shape (n_rows,)."""
    inside: Bools = np.ones(len(q_start), dtype=bool)
    if model.cell.envelope is None:
        return inside
    inside[[breach.row for breach in breaches(model, draws, sweep_path(model.cell, q_start, q_end, ways=False))]] = (
        False
    )
    turns = [in_turn(model.cell, moved) for moved in q_start != q_end]
    return inside & ~np.array(turns, dtype=bool)


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
    ahead, facing, _, _ = _facing(model, np.atleast_2d(values), path.q)
    bad = ((facing[0] <= 0) | (ahead[0] <= 0)) & ~path.between
    if bad.any():
        worst = int(np.flatnonzero(bad)[0])
        length = ahead[0, worst] / facing[0, worst]
        what = f"the mirror stands behind the fibre on this sweep (L = {length:.4g} um): no cell gives such a length"
        raise located(file, what, row=int(rows[path.row[worst]]))


def require_envelope(cell: Cell) -> Envelope:
    """The cell's envelope; `InputError` if it states none."""
    if cell.envelope is None:
        raise InputError(f"cell {cell.name!r}: expected an [envelope] table, see docs/reference/cell.md")
    return cell.envelope


def no_envelope_text(cell: Cell) -> str | None:
    """One sentence for a cell without an envelope, or with one but no gap that a plan can start from, else None."""
    if cell.envelope is None:
        return f"cell {cell.name!r} states no [envelope]: nothing keeps the mirror off the fibre"
    return None


def _facing(model: CavityModel, draws: Floats, q: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """How mirror and fibre stand at each draw and pose, shape (n_draws, n_poses) each.

    Distance of the fibre before the mirror's plane, cosine of the tilt, distance of the reflection point from the
    mirror's origin, distance of that origin along the light.
    """
    normals, origins = model.mirrors(draws, q)
    fibre, light = np.empty((len(draws), 1, 3)), np.empty((len(draws), 1, 3))
    for i, values in enumerate(draws):
        vector = model.vector(values)
        fibre[i, 0] = chain.fibre_in_world(vector)[:3, 3]
        light[i, 0] = chain.optical_axis(model.cell, vector)
    apart = origins - fibre
    ahead, facing = -(normals * apart).sum(axis=-1), -(normals * light).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        aside = np.linalg.norm(light * (ahead / facing)[..., None] - apart, axis=-1)
    return ahead, facing, np.where(facing > 1e-3, aside, 1e9), (light * apart).sum(axis=-1)


def _gap(model: CavityModel, draws: Floats, envelope: Envelope) -> tuple[Floats, float] | None:
    """What to add to each draw's length along the light, shape (n_draws,), and the sd of the gap; None if not known."""
    ahead, facing, _, _ = _facing(model, draws, home(model.cell)[None])
    length = (ahead / facing)[:, 0]
    sd, prior_sd = float(length.std()), _prior_sd(model)
    measured = len(draws) > 1 and sd < _MEASURED * prior_sd
    if envelope.gap is None or envelope.gap_sd is None:
        return (np.zeros(len(draws)), 0.0) if measured else None
    if measured:
        off, both = abs(float(length.mean()) - envelope.gap), float(np.hypot(sd, envelope.gap_sd))
        if off > SIGMAS * both:
            raise InputError(
                f"cell {model.cell.name!r}: gap_um = {envelope.gap:g} (sd {envelope.gap_sd:g}) and the measured length "
                f"{length.mean():.5g} um (sd {sd:.2g}) at joint zero disagree: mend the one that is wrong"
            )
        if sd < envelope.gap_sd:
            return np.zeros(len(draws)), 0.0
    return envelope.gap - length, envelope.gap_sd


def _prior_sd(model: CavityModel) -> float:
    """Standard deviation of the length at joint zero that the cell's priors leave, in um."""
    wide = replace(model, free=model.cell.free, held=model.cell.parameters.nominal)
    axis_model = replace(wide, cell=model.cell.with_opd("axis"))
    _, jacobian = axis_model.predict_with_jacobian(wide.free.nominal, axis_model.pose_rows(home(model.cell)[None]))
    return float(np.linalg.norm(jacobian[0] * wide.free.prior_sd))


def _rates(model: CavityModel, draws: Floats, path: JointPath) -> Floats:
    """Half waves a second on each step at `SIGMAS` standard deviations, shape (n_steps,)."""
    lengths = model.predict(draws, model.rows(path.q[path.step[:, 0]], path.q[path.step[:, 1]]))
    change = np.abs(lengths.mean(axis=0)) + SIGMAS * lengths.std(axis=0)
    seconds = np.where(path.seconds > 0, path.seconds, np.inf)
    rate: Floats = change / seconds / (model.cell.wavelength / 2.0)
    return rate


def _blind(model: CavityModel, draws: Floats, path: JointPath) -> list[tuple[int, str]]:
    """Rows that move along the beam while nobody knows the gap."""
    cell, vector = model.cell, model.vector(draws.mean(axis=0))
    directions, _ = joint_axes(cell, vector, home(cell))
    along = np.abs(directions @ chain.optical_axis(cell, vector)) > _ALONG_BEAM
    joints = np.flatnonzero(along & ~cell.revolute)
    ahead, facing, _, _ = _facing(model, draws[:1], home(cell)[None])
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
