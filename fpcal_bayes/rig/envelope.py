"""The cell's own envelope, for the moves of a rig."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import breaches
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.joint_path import JointPath, box
from fpcal_bayes.model.margin import estimate_draws, prior_draws, require_envelope

#: Poses on the straight line between two stops.
_LINE = 9


class CellEnvelope:
    """What keeps the mirror off the fibre, with what an estimate, or else the cell's prior, knows of it."""

    def __init__(self, cell: Cell, estimate: Estimate | None = None) -> None:
        self.together = require_envelope(cell).together
        self._model, self._draws = prior_draws(cell) if estimate is None else estimate_draws(estimate)

    def refusals(self, moves: Sequence[Sequence[Floats]], speed: Floats) -> list[str | None]:
        """Why each of some moves may leave the envelope, in whatever order the joints of each turn move; or None.

        Moves are the poses (n_joints,) where each begins, stops on its way and ends, in um and rad; speeds, shape
        (n_joints,), are in um/s and rad/s.
        """
        share = np.linspace(0.0, 1.0, _LINE)[:, None]
        poses, rows, steps, seconds, count = [], [], [], [], 0
        for row, stops in enumerate(moves):
            for start, end in pairwise(stops):
                turn = np.vstack([start + share * (end - start), box(self._model.cell, start, end)])
                first = count + np.arange(_LINE - 1)
                steps.append(np.column_stack([first, first + 1]))
                seconds.append(np.full(_LINE - 1, (np.abs(end - start) / speed).max() / (_LINE - 1)))
                poses.append(turn)
                rows.append(np.full(len(turn), row))
                count += len(turn)
        q, row_of = np.vstack(poses), np.concatenate(rows)
        path = JointPath(q, row_of, np.zeros(len(q), dtype=bool), np.vstack(steps), np.concatenate(seconds))
        found = breaches(self._model, self._draws, path)
        return [found.get(row) for row in range(len(moves))]
