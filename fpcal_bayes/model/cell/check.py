"""Geometry that no cell can have: mirror behind the fibre, its back to the light, a mirror that tasks cannot turn.

Only the nominal cell at joint zero is looked at. The literal reading of the paper's (13), ``optical_axis = "z"``, has
the light run along the mirror by construction; it is kept for comparison and not held to any of this.
"""

from collections.abc import Iterator

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import direction_words, home, joint_axes, sight
from fpcal_bayes.model.cell.cell import Cell

#: Farther off the light than this no mirror sends it back into the fibre, in rad.
_FARTHEST_TILT = float(np.radians(45.0))
#: Shortest wavelength in um: what is below is a length in another unit.
_SHORTEST_WAVE = 0.1
#: Turn about the normal that a task may ask of a robot beyond its limits, in rad.
_TURN_SLACK = float(np.radians(1.0))
_OR_AXES = "; or an axis points elsewhere than meant: fpcal cell shows them"


def impossible(cell: Cell) -> Iterator[tuple[str, str]]:
    """What cannot be right in the cell's geometry: the key to mend, and a sentence with the mend."""
    if cell.wavelength < _SHORTEST_WAVE:
        shown = 1e3 * cell.wavelength
        mend = f"{1e3 * shown:g}" if shown < 20.0 else "1550"
        what = f"{shown:g} nm is no light that a fibre guides, expected nm: wavelength_nm = {mend}"
        yield "optics.wavelength_nm", what
    for view, _ in cell.views:
        if view.target == "plane-mirror" and view.optical_axis != "z":
            place = f"beam {view.beam}: " if view is not cell.views[0].cell else ""
            yield from ((f"{place}{key}", what) for key, what in _misplaced(view))
    if cell.target == "plane-mirror" and cell.optical_axis != "z" and not any(_misplaced(cell.views[0].cell)):
        yield from _task_axis(cell, cell.parameters.nominal)


def _misplaced(cell: Cell) -> Iterator[tuple[str, str]]:
    vector = cell.parameters.nominal
    seen = sight(cell, vector, home(cell))
    light, normal = direction_words(seen.light), direction_words(seen.normal)
    ahead = float(seen.light @ (seen.origin - seen.fibre))
    if np.pi - seen.tilt < _FARTHEST_TILT and seen.length < 0:
        # Fibre and light stand on the mirror's front side, and the light runs away from it: both face as they should.
        theta = wrapped(_degrees(vector, "theta_wf", cell) + 180.0)
        light_away = f"the light leaves away from the mirror, along {normal}; to turn it round: theta_wf nominal_deg = "
        yield "extrinsic.theta_wf", f"{_behind(seen.length)}{light_away}{theta:g}"
    elif np.pi - seen.tilt < _FARTHEST_TILT:
        beta = _degrees(vector, "beta_et", cell) + 180.0
        yield (
            "extrinsic.beta_et",
            f"the mirror turns its back to the light at joint zero: its normal points along {normal}, as the light "
            f"does; to turn it round: beta_et nominal_deg = {wrapped(beta):g}{_OR_AXES}",
        )
    elif seen.tilt > _FARTHEST_TILT:
        text = f"the mirror stands {np.degrees(seen.tilt):.0f} deg off the light at joint zero: its normal points along"
        angles = mirror_angles(chain.tool_pose(cell, vector, home(cell))[:3, :3].T @ -seen.light)
        beta, theta = (wrapped(np.degrees(angle)) for angle in angles)
        turn = f"to turn it there: beta_et nominal_deg = {beta:g}, theta_et nominal_deg = {theta:g}{_OR_AXES}"
        yield "extrinsic.beta_et", f"{text} {normal}, the light along {light}; {turn}"
    elif not seen.length > 0:
        theta, beta = (wrapped(_degrees(vector, name, cell) + 180.0) for name in ("theta_wf", "beta_et"))
        yield (
            "extrinsic.y_wf",
            f"{_behind(seen.length)}the light leaves the fibre along {light}; either the fibre stands opposite "
            f"({_other_side(seen.fibre, seen.light, ahead)}), or light and mirror face the other way "
            f"(theta_wf nominal_deg = {theta:g} and beta_et nominal_deg = {beta:g})",
        )


def _task_axis(cell: Cell, vector: Floats) -> Iterator[tuple[str, str]]:
    """Tasks start with the mirror's Xt along Xf: a robot of six joints that cannot turn it there drives none."""
    if len(cell.joints) != 6:
        return
    joint, last = cell.joints[-1], len(cell.joints)
    seen = sight(cell, vector, home(cell))
    directions, _ = joint_axes(cell, vector, home(cell))
    turn = float(np.arctan2(np.cross(seen.across, seen.fibre_x) @ seen.normal, seen.across @ seen.fibre_x))
    about = float(directions[-1] @ seen.normal)
    most = float(np.radians(20.0)) if joint.kind == "prismatic" or abs(about) < np.cos(_FARTHEST_TILT) else 0.0
    wanted = turn * (1.0 if about > 0 else -1.0) + float(home(cell)[-1])
    if most > 0 and abs(turn) <= most:
        return
    if most == 0 and joint.low - _TURN_SLACK <= wanted <= joint.high + _TURN_SLACK:
        return
    text = (
        f"tasks start with the mirror's x axis along the fibre's ({direction_words(seen.fibre_x)}), but at joint zero "
        f"it points along {direction_words(seen.across)}"
    )
    theta = wrapped(_degrees(vector, f"theta_{last}", cell) + np.degrees(wanted - float(home(cell)[-1])))
    mend = f", and the limits of q{last} do not reach: theta nominal_deg = {theta:g}"
    if most > 0:
        mend = "; turn the last frame: theta and beta_et, as fpcal cell --new works them out"
    yield f"joint {last}.theta", text + mend


def _behind(length: float) -> str:
    return f"the mirror stands {abs(length):.4g} um behind the fibre's end at joint zero (L = {length:.4g} um): "


def _other_side(fibre: Floats, light: Floats, ahead: float) -> str:
    moved = fibre + 2.0 * light * ahead
    parts = [
        f"{name} nominal_um = {there:g}"
        for name, here, there in zip(("x_wf", "y_wf", "z_wf"), fibre, np.round(moved, 6) + 0.0, strict=True)
        if abs(here - there) > 1e-3
    ]
    return ", ".join(parts)


def mirror_angles(normal: Floats) -> tuple[float, float]:
    """beta_et and theta_et in rad that put the mirror's normal along `normal` (3,) of the tool frame, paper (14)."""
    beta = 0.0 if np.hypot(normal[1], normal[2]) < 1e-9 else float(np.arctan2(-normal[1], normal[2]))
    return beta + 0.0, float(np.arcsin(np.clip(normal[0], -1.0, 1.0))) + 0.0


def _degrees(vector: Floats, name: str, cell: Cell) -> float:
    return float(np.degrees(vector[cell.parameters[name].slot]))


def wrapped(degrees: float) -> float:
    """An angle from above -180 to 180 deg, without what rounding leaves."""
    turned = round((degrees + 180.0) % 360.0 - 180.0, 6) + 0.0
    return 180.0 if turned == -180.0 else turned
