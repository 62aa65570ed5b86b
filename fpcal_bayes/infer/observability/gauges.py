"""Directions that the data do not see, one by one, with their cause and a remedy in words.

The null space of a set of sweeps is taken apart in three layers: what no sweep and no absolute length can ever see;
what an absolute length would show; what other sweeps (or the interior of these) would show. Within a layer each
direction is reduced to as few parameters as it needs.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import listed
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.spectrum import spectrum_of
from fpcal_bayes.infer.observability.measures import pivots_of
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.beams import AT

Layer = Literal["model", "absolute", "sweeps"]

#: A parameter belongs to a direction if it moves by more than this share of the leading one, in prior units.
MEMBER_SHARE = 1e-4
_RANDOM_POSES = 120


@dataclass(frozen=True)
class Gauge:
    """One direction that the data do not see."""

    parameters: tuple[str, ...]  # names of the parameters that move, the leading one first
    # how far each moves, in its shown unit, for one prior standard deviation of the leading one; same length
    direction: tuple[float, ...]
    # ``model``: no measurement of this kind sees it; ``absolute``: one absolute length does; ``sweeps``: other sweeps
    # do
    layer: Layer
    explanation: str  # A sentence about the cause
    remedy: str  # A sentence about what makes it visible, if anything


def find_gauges(model: CavityModel, values: Floats, null_space: Floats) -> list[Gauge]:
    """Take apart the `null_space` (k, n), orthonormal in prior units, of sweeps linearised at `values` (n,)."""
    if not len(null_space):
        return []
    poses = random_poses(model, np.random.default_rng(0), _RANDOM_POSES)
    n_beams = len(model.cell.beams)
    rows = model.pose_rows(np.tile(poses, (n_beams, 1)), np.repeat(np.arange(n_beams), len(poses)))
    lengths = model.predict_with_jacobian(values, rows)[1] * model.free.prior_sd
    # Within the null space of the data: what remains unseen by any sweep, and by any length.
    never = null_space_within(null_space, lengths)
    of_beams = lengths.reshape(n_beams, len(poses), -1)
    changes = of_beams - of_beams.mean(axis=1, keepdims=True)
    without_absolute = null_space_within(null_space, changes.reshape(lengths.shape))
    basis = np.zeros((0, null_space.shape[1]))
    pivots: list[int] = []
    layers: list[Layer] = []
    spaces: list[tuple[Layer, Floats]] = [("model", never), ("absolute", without_absolute), ("sweeps", null_space)]
    for layer, space in spaces:
        found, new = sparse_basis(space, basis, pivots)
        basis = np.vstack([basis, found])
        pivots += new
        layers += [layer] * len(new)
    return [_describe(model, values, poses, *each) for each in zip(basis, pivots, layers, strict=True)]


def random_poses(model: CavityModel, rng: np.random.Generator, n: int) -> Floats:
    """Joint vectors (n, n_joints) spread over the joint limits; without limits, over a quarter turn or 1 mm."""
    cell = model.cell
    reach = np.where(cell.revolute, np.pi / 2, 1000.0)
    low = np.where(np.isfinite(cell.low), cell.low, -reach)
    return rng.uniform(low, np.where(np.isfinite(cell.high), cell.high, reach), (n, len(reach)))


def null_space_within(space: Floats, jacobian: Floats) -> Floats:
    """The part of a space (k, n) that the rows of `jacobian` (n_rows, n) do not see, orthonormal."""
    seen = jacobian @ space.T
    # Judged against what the rows see of other parameters: rounding scales with that.
    scale = float(linalg.svdvals(jacobian)[0])
    spectrum = spectrum_of(np.vstack([seen, np.zeros((1, len(space)))]))
    return spectrum.directions[spectrum.singular_values <= 1e-9 * scale] @ space


def sparse_basis(space: Floats, known: Floats, pivots: list[int]) -> tuple[Floats, list[int]]:
    """Directions that complete `known` to `space`, each with one at its own pivot parameter and zero at the others'."""
    remainder = space
    if pivots:
        remainder = space - space[:, pivots] @ linalg.solve(known[:, pivots], known)
    # Directions of the space that are already known leave nothing behind.
    _, values, rows = linalg.svd(remainder, full_matrices=False)
    remainder = rows[values > 1e-6]
    chosen = pivots_of(remainder)
    return np.asarray(linalg.solve(remainder[:, chosen], remainder)) if chosen else remainder, chosen


def _describe(model: CavityModel, values: Floats, poses: Floats, direction: Floats, pivot: int, layer: Layer) -> Gauge:
    parameters = model.free
    order = [pivot, *(int(i) for i in np.argsort(-np.abs(direction), kind="stable") if i != pivot)]
    members = [i for i in order if abs(direction[i]) > MEMBER_SHARE * abs(direction[pivot])]
    names = tuple(parameters.names[i] for i in members)
    shown = parameters.to_shown(direction * parameters.prior_sd)[members]
    step = 1e-6 * direction * parameters.prior_sd
    turns_mirror = False
    if model.cell.target == "plane-mirror":
        ahead, behind = model.mirrors(values + step, poses)[0], model.mirrors(values - step, poses)[0]
        turns_mirror = bool(np.abs(ahead - behind).max() > 1e-3 * np.abs(step).max())
    explanation = _explain(model, direction, names, layer, turns_mirror)
    remedy = {
        "model": "no sweep and no absolute length tells it; what the robot does with light does not depend on it",
        "absolute": "the absolute cavity length of one pose (a wavelength scan) shows it",
        "sweeps": "other sweeps show it: a midpoint on each where there is none, or other poses",
    }[layer]
    return Gauge(names, tuple(float(x) for x in shown), layer, explanation, remedy)


def _explain(model: CavityModel, direction: Floats, names: tuple[str, ...], layer: Layer, turns_mirror: bool) -> str:
    """Say why a direction is not seen."""
    first, others = names[0], names[1:]
    if layer == "sweeps":
        together = f" only together with {listed(others)}" if others else ""
        return f"these sweeps {'react to' if others else 'do not react to'} {first}{together}"
    if layer == "absolute":
        slides = {_stem(name) for name in names} <= {"x_wf", "y_wf", "z_wf"}
        cause = f"sliding the fibre along its axis ({listed(names)})" if slides else f"a change of {listed(names)}"
        seen = "every cavity length"
        if len(model.cell.beams) > 1:
            numbers = {model.free.position(name) for name in names}
            beams = [view.cell.beam for view, own in model.views if numbers & set(own.tolist())]
            seen = f"every length of beam {listed(beams)}"
        return f"{cause} changes {seen} by the same amount, and sweeps measure differences"
    if not others:
        return f"no cavity length depends on {first}"
    turns = sorted(n for n in names if n.startswith("theta_") and n[6:].isdigit())
    size = {name: abs(direction[model.free.position(name)]) for name in names}
    leading = {name for name in names if size[name] >= 0.1 * max(size.values())}
    if len(turns) == 2 and leading == set(turns):
        moved = [direction[model.free.position(n)] for n in turns]
        shows = "sum" if moved[0] * moved[1] < 0 else "difference"
        rest = [n for n in names if n not in turns]
        return f"{listed(turns)} turn about one axis; only their {shows} shows" + (
            f" ({listed(rest)} take{'s' if len(rest) == 1 else ''} up the rest)" if rest else ""
        )
    tilt = [n for n in names if _stem(n) in ("beta_et", "theta_et")]
    if len(turns) == 1 and tilt and len(turns) + len(tilt) == len(names):
        return f"an offset of the last joint ({turns[0]}) turns the direction of the mirror's tilt ({listed(tilt)})"
    fibre = [n for n in names if _stem(n) in ("x_wf", "y_wf", "z_wf")]
    moving = [n for n in names if n not in fibre and _stem(n) not in ("beta_wf", "theta_wf")]
    if fibre and moving:
        if turns_mirror:
            return (
                f"{listed(moving)} move mirror and fibre ({listed([n for n in names if n not in moving])}) as one body"
            )
        return (
            f"{listed(moving)} shift{'s' if len(moving) == 1 else ''} the mirror by the same vector at every pose, "
            f"and so does a shift of the fibre ({listed(fibre)})"
        )
    return f"{listed(names)} can change together without any effect on the mirror as the fibre sees it"


def _stem(name: str) -> str:
    """A parameter's name without that of its beam."""
    return name.partition(AT)[0]
