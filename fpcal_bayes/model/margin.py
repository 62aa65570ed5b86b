"""What a path leaves between mirror and fibre, with what is known of the cell.

Changes of length never see the gap itself, so it comes from the cell (``gap_um``), or from an estimate that holds a
measured length. Mirror and fibre are discs: the fibre's edge stands before the mirror's plane, or the mirror's edge
before the plane of the fibre's end; whichever keeps them farther apart counts.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import home
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.tables import Envelope
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.joint_path import JointPath, lattice

#: Standard deviations of the estimate that stay inside the envelope over a whole path.
SIGMAS = 4.0
#: Draws of an estimate that its uncertainty is judged by, and how many tell which poses need all of them.
N_DRAWS, _SCREEN = 2000, 400
#: An estimate whose length at joint zero is known this much better than the prior says has measured it.
_MEASURED = 0.5
#: Stands for a clearance where the mirror faces away.
_AWAY = -1e6
#: Draws times poses that are looked at together: what fits the processor's cache.
_BLOCK = 40_000
#: Poses in a box for each that is looked at to know it whole.
_WORTH = 6


@dataclass(frozen=True)
class Margin:
    """What is left at each pose; lengths in um, angles in rad."""

    gap: Floats  # clearance between mirror and fibre, edges included, expected, shape (n_poses,)
    gap_sd: Floats  # its standard deviation
    least_gap: Floats  # what it is at `SIGMAS` standard deviations
    tilt: Floats  # angle between light and mirror normal, expected, shape (n_poses,)
    most_tilt: Floats  # the same at `SIGMAS` standard deviations
    most_aside: Floats  # distance of the reflection point from the mirror's origin, likewise
    rate: Floats  # half waves a second on each step of the path, likewise, shape (n_steps,)
    known: bool  # whether the gap is measured; if not, `gap` counts from the nominal one


def estimate_draws(estimate: Estimate, n: int = N_DRAWS, seed: int = 0) -> tuple[CavityModel, Floats]:
    """The model of an estimate's parameters and draws of them, shape (n, n_free), from its covariance."""
    model = CavityModel.of(estimate.cell, estimate.parameters, estimate.vector())
    return model, normal_draws(estimate.values, estimate.covariance, n, seed)


def prior_draws(cell: Cell, n: int = N_DRAWS, seed: int = 0) -> tuple[CavityModel, Floats]:
    """The model of a cell's free parameters and draws of their priors, as normal ones, shape (n, n_free)."""
    return CavityModel.of(cell), normal_draws(cell.free.nominal, np.diag(cell.free.prior_sd**2), n, seed)


def normal_draws(mean: Floats, covariance: Floats, n: int = N_DRAWS, seed: int = 0) -> Floats:
    """Draws of a normal distribution whose covariance may be singular, shape (n, len(mean))."""
    values, vectors = np.linalg.eigh(covariance)
    spread = np.random.default_rng(seed).standard_normal((n, len(values))) * np.sqrt(np.clip(values, 0.0, None))
    return np.asarray(mean + spread @ vectors.T)


@dataclass(frozen=True)
class Known:
    """What is known of a cell, as draws of its model's parameters."""

    model: CavityModel  # cavity model of the parameters
    draws: Floats  # shape (n_draws, n_free), in um and rad
    fibre: Floats  # its end at each draw, shape (n_draws, 1, 3)
    light: Floats  # direction of its light, likewise

    @classmethod
    def of(cls, model: CavityModel, draws: Floats) -> "Known":
        """The same with fibre and light worked out; one draw may come as a vector."""
        draws = np.atleast_2d(draws)
        vectors = model.vector(draws)
        return cls(model, draws, vectors[:, None, -3:], chain.optical_axis(model.cell, vectors)[:, None])

    def facing(self, q: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Fibre before mirror, cosine of tilt, offset of spot, mirror's origin along it; um, (n_draws, n_poses)."""
        normals, origins = self.model.mirrors(self.draws, q)
        light = np.swapaxes(self.light, 1, 2)
        # Products with one vector a draw are products of matrices, which need no copies of the poses.
        facing = -(normals @ light)[..., 0]
        before = (origins @ light)[..., 0] - (self.fibre @ light)[..., 0]
        origins -= self.fibre
        ahead = -np.einsum("dpi,dpi->dp", normals, origins)
        with np.errstate(divide="ignore", invalid="ignore"):
            length = ahead / facing
        # The reflection point lies at `length` along the light: by Pythagoras from the mirror's origin.
        square = np.einsum("dpi,dpi->dp", origins, origins) - (2.0 * before - length) * length
        return ahead, facing, np.where(facing > 1e-3, np.sqrt(np.maximum(square, 0.0)), 1e9), before


def margin(
    model: CavityModel, draws: Floats, path: JointPath, *, exact: bool = False, rows: int = 1, boxes: bool = False
) -> Margin:
    """What a path leaves between mirror and fibre, with `draws` (n_draws, n_free) of the model's parameters.

    exact: the draws know the gap, as a simulated truth does. rows: how many share the risk (Bonferroni).
    boxes: poses that a box around many of them shows to be inside need no sizes of their own, which are NaN then.
    """
    envelope = require_envelope(model.cell)
    told = Known.of(model, draws)
    known = (np.zeros(len(told.draws)), 0.0) if exact else _gap(told, envelope)
    shift, gap_sd = (np.zeros(len(told.draws)), 0.0) if known is None else known
    sigmas = float(-ndtri(ndtr(-SIGMAS) / rows))
    few = Known(model, told.draws[:_SCREEN], told.fibre[:_SCREEN], told.light[:_SCREEN])
    bounds = (envelope, shift[:_SCREEN], gap_sd, sigmas)
    looked = _left_by_boxes(few, path.q, bounds, known is not None) if boxes else np.ones(len(path.q), dtype=bool)
    sizes = np.full((6, len(path.q)), np.nan)
    sizes[:, looked] = _sizes(few, path.q[looked], bounds)
    near = (_room(sizes, envelope) < 0).any(axis=0)
    if len(told.draws) > _SCREEN and near.any():
        sizes[:, near] = _sizes(told, path.q[near], (envelope, shift, gap_sd, sigmas))
    # Half waves a second on each step.
    lengths = model.predict(few.draws, model.rows(path.q[path.step[:, 0]], path.q[path.step[:, 1]]))
    change = np.maximum(_far(lengths, sigmas), _far(-lengths, sigmas))
    rates = change / np.where(path.seconds > 0, path.seconds, np.inf) / (model.cell.wavelength / 2.0)
    gap, spread, least, tilt, most_tilt, most_aside = sizes
    return Margin(gap, spread, least, tilt, most_tilt, most_aside, rates, known is not None)


def _room(sizes: Floats, envelope: Envelope) -> Floats:
    """What is left of gap, tilt and offset where half as much spread again is added, shape (3, n_poses)."""
    gap, _, least, tilt, most_tilt, most_aside = sizes
    return np.stack(
        [
            1.5 * least - 0.5 * gap - envelope.least_gap,
            envelope.max_tilt - 1.5 * most_tilt + 0.5 * tilt,
            envelope.mirror_radius - 1.5 * most_aside,
        ]
    )


def _left_by_boxes(few: Known, q: Floats, bounds: tuple[Envelope, Floats, float, float], gap: bool) -> Bools:
    """Which poses need a look of their own: no box of joints around many of them stays inside; `gap`: it is known."""
    # Boxes are halved while that pays; between what is looked at a quantity may bend twice as much as it does there.
    cell, left, full = few.model.cell, np.zeros(len(q), dtype=bool), np.ptp(q, axis=0) + 1e-300
    groups = [np.arange(len(q))]
    while groups:
        boxes: list[tuple[Ints, Floats, Floats, Floats, tuple[int, ...]]] = []
        for group in groups:
            low, high = q[group].min(axis=0), q[group].max(axis=0)
            poses, shape = lattice(cell, low, high)
            if len(group) > _WORTH * len(poses):
                boxes.append((group, low, high, poses, shape))
            else:
                left[group] = True
        groups, first = [], 0
        if boxes:
            room = _room(_sizes(few, np.vstack([poses for _, _, _, poses, _ in boxes]), bounds), bounds[0])
        for group, low, high, poses, shape in boxes:
            own = room[0 if gap else 1 :, first : first + len(poses)]
            first += len(poses)
            grid, bent = own.reshape(-1, *shape), np.zeros(len(own))
            for axis in range(1, grid.ndim):
                if shape[axis - 1] > 2:
                    bent += np.abs(np.diff(grid, n=2, axis=axis)).reshape(len(own), -1).max(axis=1)
            if (own.min(axis=1) > bent / 4.0).all():
                continue
            joint = int(np.argmax((high - low) / full))
            lower = q[group, joint] <= (low[joint] + high[joint]) / 2.0
            if lower.all():
                left[group] = True
            else:
                groups += [group[lower], group[~lower]]
    return left


def _sizes(known: Known, q: Floats, bounds: tuple[Envelope, Floats, float, float]) -> Floats:
    """The first six fields of a `Margin`, shape (6, n_poses)."""
    envelope, shift, gap_sd, sigmas = bounds
    sizes = np.empty((6, len(q)))
    step = max(1, _BLOCK // len(known.draws))
    for first in range(0, len(q), step):
        block = slice(first, first + step)
        ahead, facing, aside, before = known.facing(q[block])
        tilt = np.arccos(np.clip(facing, -1.0, 1.0))
        lean = np.sin(np.minimum(tilt, np.pi / 2))
        from_plane = ahead + shift[:, None] * facing - envelope.fibre_radius * lean
        from_face = before + shift[:, None] - envelope.mirror_radius * lean
        clear = np.where(facing > 0.1, np.maximum(from_plane, from_face), _AWAY)
        sizes[:3, block] = clear.mean(axis=0), np.hypot(clear.std(axis=0), gap_sd), -_far(-clear, sigmas, gap_sd)
        sizes[3:, block] = tilt.mean(axis=0), _far(tilt, sigmas), _far(aside, sigmas)
    return sizes


def _far(samples: Floats, z: float, extra_sd: float = 0.0) -> Floats:
    """Upper end at `z` sd of samples (n, m) plus a normal part, (m,), also of skew ones (Cornish and Fisher 1938)."""
    mean, sd = samples.mean(axis=0), samples.std(axis=0)
    both = np.maximum(np.hypot(sd, extra_sd), 1e-12)
    away = (samples - mean) / both
    square = away * away
    skew, kurtosis = (square * away).mean(axis=0), (square * square).mean(axis=0) - 3.0 * (sd / both) ** 4
    reach = z + (z**2 - 1) * skew / 6 + (z**3 - 3 * z) * kurtosis / 24 - (2 * z**3 - 5 * z) * skew**2 / 36
    return np.asarray(mean + both * np.maximum(reach, z))


def require_envelope(cell: Cell) -> Envelope:
    """The cell's envelope; `InputError` if it states none."""
    if cell.envelope is None:
        raise InputError(f"cell {cell.name!r}: expected an [envelope] table, see docs/reference/cell.md")
    return cell.envelope


def _gap(told: Known, envelope: Envelope) -> tuple[Floats, float] | None:
    """What to add to each draw's length along the light, shape (n_draws,), and the sd of the gap; None if not known."""
    cell, draws = told.model.cell, told.draws
    ahead, facing, _, _ = told.facing(home(cell)[None])
    length = (ahead / facing)[:, 0]
    # And the sd of the length at joint zero that the cell's priors leave, in um.
    wide = replace(told.model, free=cell.free, held=cell.parameters.nominal, cell=cell.with_opd("axis"))
    _, jacobian = wide.predict_with_jacobian(wide.free.nominal, wide.pose_rows(home(cell)[None]))
    sd, prior_sd = float(length.std()), float(np.linalg.norm(jacobian[0] * wide.free.prior_sd))
    measured = len(draws) > 1 and sd < _MEASURED * prior_sd
    if envelope.gap is None or envelope.gap_sd is None:
        return (np.zeros(len(draws)), 0.0) if measured else None
    if measured:
        off, both = abs(float(length.mean()) - envelope.gap), float(np.hypot(sd, envelope.gap_sd))
        if off > SIGMAS * both:
            raise InputError(
                f"cell {cell.name!r}: gap_um = {envelope.gap:g} (sd {envelope.gap_sd:g}) and the measured length "
                f"{length.mean():.5g} um (sd {sd:.2g}) at joint zero disagree: mend the one that is wrong"
            )
        if sd < envelope.gap_sd:
            return np.zeros(len(draws)), 0.0
    return envelope.gap - length, envelope.gap_sd


def gap_is_known(model: CavityModel, draws: Floats) -> bool:
    """Whether the cell's envelope or the draws say how far mirror and fibre are apart."""
    return _gap(Known.of(model, draws), require_envelope(model.cell)) is not None
