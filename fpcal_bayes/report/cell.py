"""A cell in words."""

from collections.abc import Iterator

import numpy as np

from fpcal_bayes.analysis.cell_view import CellView
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.axes import Sight, direction_words, sight
from fpcal_bayes.model.cell.cell import Cell


def cell_words(view: CellView) -> Iterator[str]:
    """What the cell looks like, line by line."""
    cell, seen = view.cell, view.sight
    joints = enumerate(zip(shown_joints(view), cell.joints, strict=True), 1)
    at = ", ".join(f"q{i} = {value:g} {joint.unit}" for i, (value, joint) in joints if value)
    yield f"{cell.name}: {len(cell.joints)} axes, base to mirror, at {at or 'joint zero'} (nominal geometry)"
    for axis in view.axes:
        beam = abs(float(axis.direction @ seen.light)) > 0.95
        note = (", along the beam" if axis.kind == "prismatic" else ", about the beam") if beam else ""
        yield f"  {axis.name} {axis.words}{note}; {axis.limits}"
    for part, _ in cell.views:
        if cell.beam:
            yield f"beam {part.beam}, on a {part.target}"
        yield from _beam_words(part, sight(part, part.parameters.nominal, view.q))
    if view.reach.circle is None:
        yield f"reach: no tasks ({view.reach.why_not})"
    else:
        found = zip("xz", (view.reach.tilt_x, view.reach.tilt_z), strict=True)
        tilts = ", ".join(f"{degrees_text(tilt or 0.0)} deg about {name}" for name, tilt in found)
        yield f"reach within the limits: a circle of {view.reach.circle:.4g} um radius; tilts to {tilts}"
    for text in view.odd:
        yield f"odd: {text}"
    for text in view.missing:
        yield f"not stated: {text}"


_PATHS = {
    "axis": "length along the optical axis",
    "perpendicular": "distance from the fibre to the mirror plane",
    "distance": "distance from where the light starts to the point",
}


def _beam_words(cell: Cell, seen: Sight) -> Iterator[str]:
    """How the target and the light of one beam stand."""
    start = f"its end stands at {_place(seen.fibre)} um, its light leaves along {direction_words(seen.light)}"
    if cell.target == "plane-mirror":
        across = direction_words(seen.across)
        yield f"mirror: its normal points along {direction_words(seen.normal)}, its x axis along {across}"
        yield f"fibre: {start}"
        yield from _facing(seen)
    else:
        yield f"point: it stands at {_place(seen.origin)} um"
        yield "light: " + (
            start if cell.opd == "axis" else f"it starts at {_place(seen.fibre)} um and follows the point"
        )
    yield f"path: {_PATHS[cell.opd]}; wavelength {1e3 * cell.wavelength:g} nm"


def _facing(seen: Sight) -> Iterator[str]:
    if not np.isfinite(seen.length):
        yield "gap: none, the light runs along the mirror"
        return
    side = "the mirror stands behind the fibre" if seen.length < 0 else f"gap L = {seen.length:.5g} um"
    faces = "faces the light" if seen.tilt < np.pi / 4 else "does not face the light"
    yield f"{side}; the mirror {faces}, {degrees_text(seen.tilt)} deg off"
    where = " and ".join(f"{v:.4g}" for v in np.round(seen.point_on_mirror[:2], 6) + 0.0)
    yield f"reflection point: {_place(seen.point)} um in the world, {where} um along x and y of the mirror"


def shown_joints(view: CellView) -> list[float]:
    """The joints as a person reads them, in um and deg."""
    return [float(x) for x in view.q / view.cell.joint_scales]


def _place(point: Floats) -> str:
    return f"({', '.join(f'{x:.4g}' for x in np.round(point, 6) + 0.0)})"


def degrees_text(angle: float) -> str:
    """An angle in rad as text in deg."""
    return f"{round(float(np.degrees(angle)), 6) + 0.0:.3g}"
