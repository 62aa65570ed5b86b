"""What a cell looks like: where its axes point, how mirror and fibre stand, what it reaches, what is odd or missing."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import finite
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.axes import Sight, axis_words, direction_words, home, joint_axes, sight
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.check import impossible
from fpcal_bayes.motion.tasks import follow_offsets

#: Farthest circle in um and tilt in rad that are looked for, and how closely.
_FAR_CIRCLE, _FAR_TILT, _STEPS, _POINTS = 20_000.0, float(np.radians(45.0)), 24, 25
#: Directions nearer than this count as the same, as a cosine.
_SAME = 0.966
#: Tilt at joint zero and distance of the light from the mirror's origin that are worth a word, in rad and um.
_ODD_TILT, _ODD_DISTANCE = float(np.radians(0.5)), 1000.0


@dataclass(frozen=True)
class AxisView:
    """One joint: its name, kind, direction and a point on it (shape (3,) each, um), both in words."""

    name: str
    kind: str
    direction: Floats
    point: Floats
    words: str
    limits: str


@dataclass(frozen=True)
class Reach:
    """Largest circle in um and tilts about Xf and Zf in rad within the limits, or None and the reason."""

    circle: float | None = None
    tilt_x: float | None = None
    tilt_z: float | None = None
    why_not: str = ""


@dataclass(frozen=True)
class CellView:
    """A cell at one joint vector `q` (n_joints,), in um and rad, with sentences; `refused` says why, or is empty."""

    cell: Cell
    q: Floats
    axes: tuple[AxisView, ...]
    sight: Sight
    reach: Reach
    odd: tuple[str, ...]
    missing: tuple[str, ...]
    refused: str

    def content(self) -> dict[str, Any]:
        """The view as JSON, in um and deg."""
        seen, scales = self.sight, self.cell.joint_scales
        tilts = {name: getattr(self.reach, name) for name in ("tilt_x", "tilt_z")}
        return {
            "q": {name: finite(v) for name, v in zip(self.cell.joint_columns, self.q / scales, strict=True)},
            "axes": [
                {"name": a.name, "kind": a.kind, "direction": a.direction.tolist(), "words": a.words} for a in self.axes
            ],
            "mirror": {"normal": seen.normal.tolist(), "origin_um": seen.origin.tolist()},
            "fibre": {"end_um": seen.fibre.tolist(), "light": seen.light.tolist()},
            "length_um": finite(seen.length),
            "tilt_deg": float(np.degrees(seen.tilt)),
            "faces_the_light": bool(seen.tilt < np.pi / 2 and seen.length > 0),
            "reflection_point_um": [finite(x) for x in seen.point],
            "reach": {
                "circle_um": self.reach.circle,
                **{f"{name}_deg": None if v is None else float(np.degrees(v)) for name, v in tilts.items()},
                "why_not": self.reach.why_not,
            },
            "odd": list(self.odd),
            "missing": list(self.missing),
            "refused": self.refused,
        }


def view_cell(cell: Cell, q: Floats | None = None) -> CellView:
    """Look at a nominal cell at joint vector `q`; one that cannot be right is shown too, with the reason."""
    vector = cell.parameters.nominal
    at = home(cell) if q is None else q
    seen = sight(cell, vector, at)
    directions, points = joint_axes(cell, vector, at)
    axes = tuple(_axis(cell, i, directions[i], points[i]) for i in range(len(cell.joints)))
    refused = next((f"key {key}: {what}" for key, what in impossible(cell)), "")
    reach = Reach(why_not="its geometry cannot be right") if refused else _reach(cell, vector)
    return CellView(cell, at, axes, seen, reach, tuple(_odd(cell, axes, seen)), tuple(_missing(cell)), refused)


def _axis(cell: Cell, i: int, direction: Floats, point: Floats) -> AxisView:
    joint, scale = cell.joints[i], cell.joint_scales[i]
    limits = f"{joint.low / scale:g} to {joint.high / scale:g} {joint.unit}"
    limits = limits if np.isfinite(joint.low) or np.isfinite(joint.high) else "without limit"
    return AxisView(f"q{i + 1}", joint.kind, direction, point, axis_words(joint.kind, direction), limits)


def _reach(cell: Cell, vector: Floats) -> Reach:
    """Largest circle and tilts of which every point can be driven to."""
    turn = np.linspace(0.0, 2.0 * np.pi, _POINTS)
    ways = {"circle": (0, 2), "tilt_x": (3,), "tilt_z": (5,)}
    found: dict[str, float] = {}
    try:
        for name, columns in ways.items():
            unit = np.zeros((_POINTS, 6))
            shares = (np.cos(turn), np.sin(turn)) if name == "circle" else (np.linspace(-1.0, 1.0, _POINTS),)
            for column, share in zip(columns, shares, strict=True):
                unit[:, column] = share
            found[name] = _largest(cell, vector, unit, _FAR_CIRCLE if name == "circle" else _FAR_TILT)
    except InputError as error:
        return Reach(why_not=str(error))
    return Reach(found["circle"], found["tilt_x"], found["tilt_z"])


def _largest(cell: Cell, vector: Floats, unit: Floats, far: float) -> float:
    """The largest factor on moves `unit` (n, 6) at which all of them can be driven to."""
    if bool(follow_offsets(cell, vector, "reach", far * unit).ok.all()):
        return far
    low, high = 0.0, far
    for _ in range(_STEPS):
        middle = (low + high) / 2.0
        good = bool(follow_offsets(cell, vector, "reach", middle * unit).ok.all())
        low, high = (middle, high) if good else (low, middle)
    return low


def _odd(cell: Cell, axes: tuple[AxisView, ...], seen: Sight) -> list[str]:
    """What may be meant, but seldom is."""
    found = []
    for i, first in enumerate(axes):
        for second in axes[i + 1 :]:
            if first.kind == second.kind and abs(float(first.direction @ second.direction)) > _SAME:
                verb = "move along" if first.kind == "prismatic" else "turn about"
                found.append(f"{first.name} and {second.name} both {verb} {direction_words(first.direction)[1:2]}")
    moving = [axis.direction for axis in axes if axis.kind == "prismatic"]
    if moving and not any(abs(float(along @ seen.light)) > 0.5 for along in moving):
        found.append("no axis moves along the beam")
    mirror = cell.target == "plane-mirror"
    if mirror and np.isfinite(seen.length) and _ODD_TILT < seen.tilt < np.pi / 2:
        found.append(f"the mirror stands {np.degrees(seen.tilt):.3g} deg off the light")
    away = float(np.linalg.norm(seen.point_on_mirror[:2]))
    if mirror and away > (_ODD_DISTANCE if cell.envelope is None else cell.envelope.mirror_radius):
        found.append(f"the light meets the mirror's plane {away:.4g} um from the mirror's origin")
    outside = [f"q{i + 1}" for i in range(len(axes)) if not cell.low[i] <= 0.0 <= cell.high[i]]
    if outside:
        found.append(f"joint zero is outside the limits of {', '.join(outside)}")
    return found


def _missing(cell: Cell) -> list[str]:
    """Numbers of data sheets and measurements that the file does not state."""
    names = {
        "limits": [i for i, j in enumerate(cell.joints) if j.kind == "prismatic" and not np.isfinite(j.high - j.low)],
        "repeatability": [i for i, j in enumerate(cell.joints) if j.repeatability == 0],
        "controller": [i for i, j in enumerate(cell.joints) if j.controller is None],
        "speed": [i for i, j in enumerate(cell.joints) if j.speed is None],
    }
    keys = {"limits": "limits_um", "repeatability": "repeatability_um or _deg", "speed": "speed_um_per_s or _deg_per_s"}
    unknown = ((keys.get(what, what), joints) for what, joints in names.items() if joints)
    found = [f"{key} of {', '.join(f'q{i + 1}' for i in joints)}" for key, joints in unknown]
    if not cell.drift:
        found.append("drift: without it track and decide refuse to guess")
    if cell.envelope is None:
        found.append("[envelope]: nothing keeps the mirror off the fibre")
    elif cell.envelope.gap is None:
        found.append("gap_um and gap_sd_um of [envelope], the measured gap: lengths tell its changes only")
    return found
