"""The error motions that a calibration found, as curves over the joint's value."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics import group_of
from fpcal_bayes.model.mechanics.response import ROLL
from fpcal_bayes.model.mechanics.terms import harmonics, polynomials

_POINTS = 61


@dataclass(frozen=True)
class MotionCurve:
    """One error motion: a band that holds 95 %, in nm or urad."""

    name: str
    unit: str
    joint_unit: str
    along: Floats  # values of the joint in um or deg, shape (n_points,)
    low: Floats
    middle: Floats
    high: Floats
    stated: Floats  # one standard deviation that the sheet stands for, shape (n_points,)
    shown: float  # share of the prior's variance that the data took away
    # joint, direction: position of the joint, and the direction of `Responses.motion`
    joint: int
    direction: int


def motion_curves(estimate: Estimate) -> list[MotionCurve]:
    """The error motions that an estimate knows, those that the data show most first; none on a perfect mechanism."""
    knowledge, cell = estimate.mechanics, estimate.cell
    if knowledge is None:
        return []
    names, mean, root = knowledge.weights(knowledge.n_parameters)
    weights = mean + knowledge.draws @ root.T
    scales = np.exp(knowledge.log_scales)
    curves, first = [], 0
    for motion in knowledge.terms(cell).motions:
        there = motion.sd > 0
        own = slice(first, first + int(there.sum()))
        first = own.stop
        assert all(name.startswith(motion.name) for name in names[own])
        i, endless = motion.joint, group_of(cell, motion.joint) == "rotary"
        low, high = (-np.pi, np.pi) if endless else (cell.low[i], cell.high[i])
        q = np.linspace(low, high, _POINTS)
        basis = (harmonics(q) if endless else polynomials(q, low, high))[:, : len(motion.sd)] * motion.sd
        unit, factor = ("nm", 1e3) if motion.direction < ROLL else ("urad", 1e6)
        values = factor * weights[:, own] @ basis[:, there].T
        size = scales[:, knowledge.scales.index(motion.scale)]
        stated = factor * np.sqrt((basis[:, there] ** 2).sum(axis=1))
        shown = 1.0 - float((values.var(axis=0) / np.maximum((np.median(size) * stated) ** 2, 1e-30)).mean())
        least, middle, most = np.quantile(values, [0.025, 0.5, 0.975], axis=0)
        about = motion.name, unit, cell.joints[i].unit, q / cell.joint_scales[i]
        curves.append(MotionCurve(*about, least, middle, most, stated, shown, i, motion.direction))
    return sorted(curves, key=lambda curve: -curve.shown)


def axis_tables(estimate: Estimate) -> dict[int, dict[str, Floats]]:
    """Error motions by joint position, mean and 95 % band as columns over the joint's value; to compensate subtract.

    Names are those of ISO 230-1: EYX is what a joint along X, the nearest world axis, moves along Y; A B C are turns.
    """
    knowledge, tables = estimate.mechanics, dict[int, dict[str, Floats]]()
    if knowledge is None:
        return tables
    world = knowledge.terms(estimate.cell).told.in_world
    for curve in sorted(motion_curves(estimate), key=lambda curve: (curve.joint, curve.direction)):
        axes = world[curve.joint]
        own, felt = (int(np.argmax(np.abs(axes[:, k]))) for k in (0, curve.direction % 3))
        letters = "XYZ" if curve.direction < ROLL else "ABC"
        name = f"E{letters[felt]}{('ABC' if estimate.cell.revolute[curve.joint] else 'XYZ')[own]}"
        table = tables.setdefault(curve.joint, {f"q{curve.joint + 1}_{curve.joint_unit}": curve.along})
        edges = [curve.low, curve.high] if axes[felt, curve.direction % 3] > 0 else [-curve.high, -curve.low]
        middle = curve.middle * np.sign(axes[felt, curve.direction % 3])
        for part, values in (("", middle), ("_low", edges[0]), ("_high", edges[1])):
            table[f"{name}{part}_{curve.unit}"] = values
    return tables
