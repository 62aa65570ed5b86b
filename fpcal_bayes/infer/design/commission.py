"""Small moves around joint zero that tell how the axes of a new cell are connected, before anything else is measured.

One joint moves at a time while the others stand a little to either side: a tilt changes the length by how far the
mirror was moved across, so that signs, order and scales of all axes hang together. Reflecting the world in a plane with
the beam changes no length; which of these images the cell is nobody but its user sees.
"""

import numpy as np

from fpcal_bayes.infer.design.candidates import SweepLimits, visible_ranges
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.margin import prior_draws

#: What the labels of such sweeps begin with.
LABEL = "commission"
#: Sweeps of each joint; moves that travel in um, that tilt in deg, and turns about the beam in deg.
_EACH, _TRAVEL, _TILT, _SPIN = 6, 4.0, 3.0, 60.0
#: A joint that keeps the light in sight over more than this turns about the beam, in deg.
_FAR_TURN = 10.0


def commission_plan(cell: Cell) -> Sweeps:
    """Sweeps to commission a cell with, as a plan; `InputError` if the mirror is out of sight at joint zero."""
    n, rng = len(cell.joints), np.random.default_rng(0)
    ranges = visible_ranges(CavityModel.of(cell), cell.free.nominal, SweepLimits().within_envelope(*prior_draws(cell)))
    # Whatever the side, the moves stay inside.
    room = np.minimum(ranges[1], -ranges[0]) / cell.joint_scales
    turn = np.where(room > _FAR_TURN, _SPIN, _TILT)
    size = np.minimum(np.where(cell.revolute, turn, _TRAVEL), room) * cell.joint_scales
    moving = np.flatnonzero(size > 0)
    start, end = (np.zeros((len(moving) * _EACH, n)) for _ in range(2))
    for row, joint in enumerate(np.tile(moving, _EACH)):
        beside = rng.choice([-1.0, 1.0], n) * size * (row >= len(moving))
        start[row], end[row] = beside, beside
        start[row, joint] = beside[joint] if rng.integers(2) else 0.0
        end[row, joint] = -start[row, joint] if start[row, joint] else size[joint]
    names = [f"{LABEL}-q{joint + 1}-{turn + 1}" for turn in range(_EACH) for joint in moving]
    return Sweeps.of_um_rad(start, end, label=names, file=LABEL)
