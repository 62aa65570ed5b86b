"""Compiled kernel that whitens rows sharing a reading, and the loading of all kernels of an identification."""

import sys

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.compile import compiled, needs_compilation
from fpcal_bayes.model.kernels.jacobian import batch_jacobians
from fpcal_bayes.model.kernels.lengths import LANES, batch_lengths, few_vector_lengths


@compiled
def whiten_groups(rows: Floats, members: Ints, own: Floats, shared: Floats, gain: Floats, scale: Floats) -> None:
    """Take off each row, in place, what those before it in its group tell about their common errors.

    rows: shape (n_points, n_rows, n), contiguous; the members are overwritten. The others are fields of a `Batch`.
    """
    n_groups, n_members, n_common = shared.shape
    n = rows.shape[2]
    told = np.empty((n_common, n))
    for p in range(rows.shape[0]):
        for g in range(n_groups):
            told[:] = 0.0
            for m in range(n_members):
                row = members[g, m]
                for j in range(n):
                    value = rows[p, row, j] * own[g, m]
                    predicted = 0.0
                    for c in range(n_common):
                        predicted += gain[g, m, c] * told[c, j]
                        told[c, j] += shared[g, m, c] * value
                    rows[p, row, j] = (value - predicted) * scale[g, m]


def warm_up(cell: Cell) -> None:
    """Load the kernels, so that times do not count it; say so if they have to be compiled first."""
    if needs_compilation(batch_lengths, few_vector_lengths, batch_jacobians, whiten_groups):
        print("fpcal: compiling the kernels; this happens once and takes about 20 s", file=sys.stderr)
    model, home = CavityModel.of(cell), np.zeros((1, len(cell.joints)))
    model.predict(model.free.nominal, model.pose_rows(home))
    model.predict(model.free.nominal, model.pose_rows(home + 1e-6 * np.arange(LANES + 1)[:, None]))
    model.predict_with_jacobian(model.free.nominal, model.pose_rows(home))
    one = np.ones((1, 1, 1))
    whiten_groups(one, np.zeros((1, 1), dtype=np.int64), one[0], one, one, one[0])
