"""A cell as one picture: a schematic in which directions are true and distances are not."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fpcal_bayes.analysis.cell_view import AxisView, CellView
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.report.cell import degrees_text, shown_joints
from fpcal_bayes.report.pages import BLUE, GREEN, ORANGE, VERMILION, drawable

#: Where x, y and z of the world point on the page: x towards the reader, y to the right, z up.
_PAGE = np.array([[-0.56, 0.93, 0.0], [-0.42, -0.17, 0.98]])
_TOWARDS_READER = np.cross(_PAGE[0], _PAGE[1])
#: Sizes on the page: between joints, half an axis, a turn's circle, the mirror, fibre and beam.
_APART, _HALF, _TURN, _MIRROR, _FIBRE, _BEAM = 2.5, 0.85, 0.5, 0.95, 1.5, 2.3


def cell_figure(view: CellView) -> Figure:
    """The picture: axes drawn apart in their order, then mirror, beam and fibre, all in one view of the world."""
    n = len(view.axes)
    figure = Figure(figsize=(max(7.0, 1.4 * (n + 3)), 3.7))
    axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axis.set_axis_off()
    places = [np.array([_APART * i, 0.0]) for i in range(n)]
    if places:
        axis.plot([-1.3, places[-1][0]], [0, 0], color="0.8", linewidth=6, solid_capstyle="butt", zorder=0)
    axis.plot([-1.3, -1.3], [-0.5, 0.5], color="0.45", linewidth=4, solid_capstyle="butt")
    axis.text(-1.3, 0.62, "base", ha="center", fontsize=9, color="0.3")
    for place, joint in zip(places, view.axes, strict=True):
        _draw_joint(axis, place, joint)
    world = np.array([-1.3, -2.35])
    for name, direction in zip("xyz", np.eye(3), strict=True):
        _arrow(axis, world, world + 0.55 * _PAGE @ direction, "black", 1.2)
        x, y = world + 0.75 * _PAGE @ direction
        axis.text(x, y, name, fontsize=9, ha="center", va="center")
    end = np.array([_APART * n + 1.6, 0.1])
    axis.plot([places[-1][0], end[0]], [0, end[1]], color="0.8", linewidth=6, solid_capstyle="butt", zorder=0)
    _draw_optics(axis, end, view)
    at = ", ".join(f"q{i}={v:g}" for i, v in enumerate(shown_joints(view), 1) if v)
    title = f"{drawable(view.cell.name)} at {at or 'joint zero'}" + ("  (refused)" if view.refused else "")
    axis.text(-1.6, 2.3, title, fontsize=11, va="top", parse_math=False)
    note = "Directions are true; axes are drawn apart, lengths not to scale."
    axis.text(-1.6, -3.15, note, fontsize=8, color="0.35", va="bottom")
    axis.set(aspect="equal", xlim=(-2.1, end[0] + 4.6), ylim=(-3.3, 2.5))
    return figure


def _draw_joint(axis: Axes, place: Floats, joint: AxisView) -> None:
    along = joint.direction
    tip, tail = place + _HALF * _PAGE @ along, place - _HALF * _PAGE @ along
    colour = BLUE if joint.kind == "prismatic" else VERMILION
    if joint.kind == "prismatic":
        _arrow(axis, tail, tip, colour, 2.6)
    else:
        axis.plot(*zip(tail, tip, strict=True), color=colour, linewidth=1.0, linestyle=(0, (5, 2)))
        ring = _circle(place, along, _TURN, np.linspace(20.0, 320.0, 60))
        axis.plot(*ring.T[:, :-3], color=colour, linewidth=2.4)
        _arrow(axis, ring[-6], ring[-1], colour, 2.4)
        _arrow(axis, place + 0.8 * (tip - place), tip, colour, 1.0)
    axis.plot(*place, "o", color="black", markersize=4)
    plus = tip + 0.22 * (tip - place) / max(float(np.linalg.norm(tip - place)), 1e-9)
    axis.text(plus[0], plus[1], "+", fontsize=11, color=colour, ha="center", va="center")
    head, _, rest = joint.words.partition(", ")
    text = f"{joint.name}\n{head.replace('moves along', 'moves')}"
    axis.text(place[0], -1.35, text, ha="center", va="top", fontsize=9, fontweight="bold", linespacing=1.25)
    if rest:
        off = rest.replace(" towards", "\ntowards")
        axis.text(place[0], -2.08, off, ha="center", va="top", fontsize=7.5, color=colour)


def _draw_optics(axis: Axes, place: Floats, view: CellView) -> None:
    seen = view.sight
    disc = _circle(place, seen.normal, _MIRROR, np.linspace(0.0, 360.0, 90))
    back = disc - 0.16 * _PAGE @ seen.normal
    # What lies behind is drawn first: the mirror's front hides its body, or the body its front.
    axis.fill(*back.T, facecolor="0.55", edgecolor="0.25", zorder=2 if float(_TOWARDS_READER @ seen.normal) >= 0 else 4)
    axis.fill(*disc.T, facecolor="#dceefb", edgecolor="0.25", linewidth=1.2, zorder=3)
    normal = place + 0.95 * _PAGE @ seen.normal
    _arrow(axis, place, normal, GREEN, 2.0, zorder=6)
    # Beside the disc, on the side that the arrow points to.
    side = float(np.sign(np.round(normal[0] - place[0], 1)))
    words = {1.0: "left", -1.0: "right"}.get(side, "center")
    axis.text(normal[0] - 0.1 * side, normal[1] + 0.14, "normal", color=GREEN, size=9, ha=words, va="bottom", zorder=7)
    # A fibre above or below has less room, and words beside it.
    upright = abs(float((_PAGE @ seen.light)[1])) > 0.7
    room = 0.6 if upright else 1.0
    ahead = room * _BEAM * (1.0 if not np.isfinite(seen.length) else np.sign(seen.length))
    fibre = place - ahead * _PAGE @ seen.light
    root = fibre - room * _FIBRE * _PAGE @ seen.light
    axis.plot(*zip(root, fibre, strict=True), color="0.5", linewidth=9, solid_capstyle="butt", zorder=5)
    axis.plot(*zip(root, fibre, strict=True), color="white", linewidth=6, solid_capstyle="butt", zorder=5)
    axis.plot(*zip(root, fibre, strict=True), color=ORANGE, linewidth=1.6, solid_capstyle="butt", zorder=5)
    _arrow(axis, fibre, fibre + (abs(ahead) if ahead > 0 else 1.2) * _PAGE @ seen.light, ORANGE, 2.0, zorder=5.5)
    label = (root + fibre) / 2.0 + ([0.55, 0.0] if upright else [0.0, 0.32])
    axis.text(label[0], label[1], "fibre", fontsize=9, ha="center", va="center", color="0.3")
    wrong = bool(view.refused) or seen.length < 0 or not np.isfinite(seen.length)
    gap = f"gap {seen.length:.4g} um" if np.isfinite(seen.length) else "no gap"
    if seen.length < 0:
        gap = f"mirror {-seen.length:.4g} um\nbehind the fibre"
    text, colour = f"{gap}\n{degrees_text(seen.tilt)} deg off the light", VERMILION if wrong else "black"
    axis.text(place[0] + (2.4 if upright else 0.9), -1.35, text, fontsize=9, ha="center", va="top", color=colour)


def _arrow(axis: Axes, start: Floats, end: Floats, colour: str, width: float, zorder: float = 3) -> None:
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": width, "mutation_scale": 13, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", (end[0], end[1]), (start[0], start[1]), arrowprops=style, zorder=zorder)


def _circle(place: Floats, direction: Floats, radius: float, angles_deg: Floats) -> Floats:
    """Points (n, 2) on the page of a circle about a direction, right-handed with it."""
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(direction)))], direction)
    first /= np.linalg.norm(first)
    angle = np.radians(angles_deg)[:, None]
    points = radius * (np.cos(angle) * first + np.sin(angle) * np.cross(direction, first))
    return np.asarray(place + points @ _PAGE.T)
