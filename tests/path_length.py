"""The cavity length from the frames of `fpcal_bayes.model.chain`, which kernels are held to."""

from typing import Any

import numpy as np

from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell


def path_length(cell: Cell, vector: chain.Matrix, q: chain.Matrix) -> Any:
    """Cavity length L in um at one joint vector, paper equation (24), for the cell's own path model."""
    mirror, fibre = chain.mirror_pose(cell, vector, q), chain.fibre_in_world(vector)
    normal, to_mirror = mirror[:3, 2], mirror[:3, 3] - fibre[:3, 3]
    distance = normal @ to_mirror
    if cell.opd == "axis":
        return distance / (normal @ chain.optical_axis(cell, vector))
    return distance if np.real(distance) >= 0 else -distance
