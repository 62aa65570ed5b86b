"""The angles of a cell worked out from where its axes point, or from modified Denavit-Hartenberg parameters.

Each link stands RotY(beta) RotX(alpha) TransX(d) RotZ(theta) TransZ(r) on the one before it. Along a chain of axes that
point along +-x, +-y, +-z the theta of a link is turned such that the next axis is reached by alpha alone; parallel
neighbours get Hayati's beta beside alpha, since there theta and alpha cannot tell a small change of direction.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.check import mirror_angles, wrapped
from fpcal_bayes.model.cell.joints import JointKind

_WORD = re.compile(r"(?P<sign>[+-]?)(?P<turns>r?)(?P<inner>[+-]?)(?P<axis>[xyz])")
_QUARTERS = (0.0, -90.0, 90.0, 180.0)
#: Links of a chain at most: more is a mistake in the words.
_MOST_AXES = 12


@dataclass(frozen=True)
class AxisWord:
    """One axis in words: ``x``, ``-z``, ``ry``, ``-rx`` (turns about -x)."""

    kind: JointKind
    direction: tuple[int, int, int]

    @property
    def vector(self) -> Floats:
        """The direction, shape (3,)."""
        return np.array(self.direction, dtype=float)


@dataclass(frozen=True)
class Layout:
    """Nominal geometry of a cell; angles in deg, lengths in um, as files hold them."""

    kinds: tuple[JointKind, ...]  # one entry per joint, from base to tool
    links: Floats  # beta, alpha, d, theta, r of each link, shape (n_joints, 5)
    free: frozenset[str]  # names of the parameters that are worth a prior
    beta_et: float  # angles of the mirror
    theta_et: float
    beta_wf: float  # angles of the fibre
    theta_wf: float
    fibre: Floats  # end of the fibre in the world frame, shape (3,)
    side: Floats  # direction from the mirror to the fibre, shape (3,)
    gap: float  # distance from the fibre's end to the mirror at joint zero

    def directions(self) -> Floats:
        """Where each axis points at joint zero, in the world frame, shape (n_joints, 3)."""
        return np.array([frame[:3, 2] for frame in _frames(self.links)[1:]])


def read_axes(text: str) -> tuple[AxisWord, ...]:
    """Axes from words such as ``x y z rx rz -ry``, from base to mirror; `InputError` if a word is none."""
    axes = []
    for word in text.replace(",", " ").split():
        found = _WORD.fullmatch(word.lower())
        if found is None or (found["inner"] and not found["turns"]) or (found["sign"] and found["inner"]):
            allowed = "x, y or z (moves along), rx, ry or rz (turns about), with - in front"
            raise InputError(f"axis {word!r:.40}: expected {allowed}")
        direction = [0, 0, 0]
        direction["xyz".index(found["axis"])] = -1 if "-" in (found["sign"], found["inner"]) else 1
        axes.append(AxisWord("revolute" if found["turns"] else "prismatic", (direction[0], direction[1], direction[2])))
    if not 1 <= len(axes) <= _MOST_AXES:
        raise InputError(f"{len(axes)} axes: expected 1 to {_MOST_AXES}, from base to mirror, as in 'x y z rx rz ry'")
    return tuple(axes)


def read_side(text: str) -> Floats:
    """Direction from the mirror to the fibre from a word such as ``+y``, shape (3,)."""
    try:
        (axis,) = read_axes(text.replace("minus-", "-"))
    except (InputError, ValueError):
        axis = AxisWord("revolute", (0, 0, 1))
    if axis.kind != "prismatic":
        raise InputError(f"side {text!r:.40}: expected +x, -x, +y, -y, +z or -z, from the mirror to the fibre")
    return axis.vector


def layout_of_axes(axes: Sequence[AxisWord], side: Floats, gap: float) -> Layout:
    """The layout of axes that meet at the mirror, with the fibre `gap` um away in the direction `side` (3,)."""
    links, frame = np.zeros((len(axes), 5)), np.eye(3)
    for i, axis in enumerate(axes):
        if i > 0:
            # The turn about z after which the next axis has no x component.
            across = (frame.T @ axis.vector)[0]
            links[i - 1, 3] = 0.0 if abs(across) < 0.5 else -90.0 if across > 0 else 90.0
            frame = frame @ chain.rot_z(np.radians(links[i - 1, 3]))[:3, :3]
        wanted = np.round(frame.T @ axis.vector)
        if wanted[0]:
            # Only the first axis may point along x of the frame before it, the world's.
            links[i, 0] = 90.0 * wanted[0]
        else:
            links[i, 1] = np.degrees(np.arctan2(-wanted[1], wanted[2])) + 0.0
        frame = frame @ (chain.rot_y(np.radians(links[i, 0])) @ chain.rot_x(np.radians(links[i, 1])))[:3, :3]
    return _faced(tuple(axis.kind for axis in axes), links, side, gap)


def layout_of_links(kinds: Sequence[JointKind], links: Floats, side: Floats, gap: float) -> Layout:
    """The layout of links beta, alpha, d, theta, r in deg and um, (n_joints, 5), the last axis turned for tasks."""
    return _faced(tuple(kinds), np.array(links, dtype=float), side, gap)


def _faced(kinds: tuple[JointKind, ...], links: Floats, side: Floats, gap: float) -> Layout:
    """Turn mirror and fibre to each other, the mirror's x axis along the fibre's as far as quarter turns go."""
    last = _frames(links)[-1]
    about = abs(float(last[:3, 2] @ side))
    best: tuple[float, ...] = (np.inf,)
    found = (0.0,) * 5
    for beta_wf, theta_wf in product(_QUARTERS, _QUARTERS):
        fibre = (chain.rot_x(np.radians(beta_wf)) @ chain.rot_z(np.radians(theta_wf)))[:3, :3]
        # With the light along the world's x, theta_wf must tilt it about z: beta_1 tilts the robot about y.
        if fibre[:, 1] @ side < 0.5 or (abs(theta_wf) == 90.0 and abs(beta_wf) == 90.0):
            continue
        for turn in _turns(last[:3, :3], side, fibre[:, 0], about):
            frame = last[:3, :3] @ chain.rot_z(np.radians(turn))[:3, :3]
            for beta_et, theta_et in _mirror_choices(frame.T @ side):
                mirror = frame @ (chain.rot_x(np.radians(beta_et)) @ chain.rot_y(np.radians(theta_et)))[:3, :3]
                off = float(np.degrees(np.arccos(np.clip(mirror[:, 0] @ fibre[:, 0], -1.0, 1.0))))
                angles = (turn, beta_et, theta_et, beta_wf, theta_wf)
                # beta_et tilts no mirror whose theta_et is a quarter turn; the last theta does then.
                cost = (round(off, 3), float(abs(np.cos(np.radians(theta_et))) < 0.5), float(np.abs(angles).sum()))
                if cost < best:
                    best, found = cost, angles
    turn, beta_et, theta_et, beta_wf, theta_wf = found
    links = links.copy()
    links[-1, 3] = wrapped(links[-1, 3] + turn)
    end = _frames(links)[-1][:3, 3] + gap * side
    free = _worth_a_prior(kinds, links, side, theta_et, theta_wf)
    return Layout(kinds, links, free, beta_et, theta_et, beta_wf, theta_wf, end + 0.0, side, gap)


def _turns(frame: Floats, side: Floats, across: Floats, about: float) -> list[float]:
    """Turns of the last frame about its own axis that may bring the mirror's x axis along `across`, in deg."""
    if about < 0.9:
        return list(_QUARTERS)
    x, y = float(frame[:, 0] @ across), float(frame[:, 1] @ across)
    exact = round(float(np.degrees(np.arctan2(y, x))), 6)
    return [wrapped(exact + quarter) for quarter in _QUARTERS]


def _mirror_choices(normal: Floats) -> list[tuple[float, float]]:
    """Angles beta_et and theta_et in deg that put the mirror's normal along `normal` (3,) of the tool frame."""
    beta, theta = (round(float(np.degrees(angle)), 6) for angle in mirror_angles(normal))
    if np.hypot(normal[1], normal[2]) < 1e-6:
        return [(quarter, theta) for quarter in _QUARTERS]
    return [(beta, theta), (wrapped(beta + 180.0), wrapped(180.0 - theta))]


def _worth_a_prior(
    kinds: tuple[JointKind, ...], links: Floats, side: Floats, theta_et: float, theta_wf: float
) -> frozenset[str]:
    """Parameters that lengths can tell in principle: not the direction of the world's own axes."""
    axes = [frame[:3, 2] for frame in _frames(links)[1:]]
    parallel = [i > 0 and abs(float(axes[i - 1] @ axes[i])) > 0.99 for i in range(len(axes))]
    # The first axis is the world's own, and so is the turn about it until another axis points elsewhere.
    fixed = next((i for i in range(1, len(axes)) if abs(float(axes[0] @ axes[i])) < 0.99), len(axes))
    free = set()
    for i, kind in enumerate(kinds):
        number = i + 1
        if i > 0:
            free.add(f"alpha_{number}")
        if i >= fixed:
            free.add(f"theta_{number}")
        if parallel[i]:
            free.add(f"beta_{number}")
        # Where an axis along the normal pierces the mirror leaves no trace in a length.
        if kind == "revolute" and i > 0 and abs(float(axes[i] @ side)) < 0.99:
            free.add(f"d_{number}")
    free |= {"theta_et", "theta_wf", "z_et", "x_wf", "y_wf", "z_wf"}
    if abs(np.cos(np.radians(theta_et))) > 0.5:
        free.add("beta_et")
    # With the light along the world's x, beta_wf turns about the light: the tilt it cannot make is the robot's.
    free.add("beta_wf" if abs(np.cos(np.radians(theta_wf))) > 0.5 else "beta_1")
    return frozenset(free)


def _frames(links: Floats) -> list[Floats]:
    frames = [np.eye(4)]
    for beta, alpha, d, theta, r in links:
        link = np.array([np.radians(beta), np.radians(alpha), d, np.radians(theta), r, 0.0, 0.0, 0.0])
        frames.append(frames[-1] @ chain.link_transform(link, 0.0, True))
    return frames
