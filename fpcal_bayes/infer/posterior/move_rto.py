"""emcee move: independent proposals from an atlas of charts."""

from typing import Any

import numpy as np
from emcee.moves import Move
from emcee.state import State

from fpcal_bayes.infer.posterior.atlas import Atlas
from fpcal_bayes.infer.posterior.chart import Solved


class RandomiseThenOptimiseMove(Move):  # type: ignore[misc]
    """Metropolis-Hastings with independent proposals from an atlas.

    Each walker carries the log density with which the atlas proposes its place (the blob), so that the step is exact
    also for walkers outside every chart: from there any move inside is refused, as none leads back. Another move has to
    bring them in and out.

    Proposals do not depend on where the walkers stand, so those of several steps are made at once.

    Parameters
    ----------
    atlas
        The charts.
    ahead
        For how many steps proposals are made at once.
    """

    def __init__(self, atlas: Atlas, ahead: int = 1) -> None:
        self.atlas, self.ahead = atlas, ahead
        self._ready: list[Solved] = []

    def forget(self) -> None:
        """Drop the proposals made ahead, which are no part of the random state."""
        self._ready.clear()

    def propose(self, model: Any, state: State) -> tuple[State, Any]:
        """Move every walker once."""
        random = model.random
        if not self._ready:
            self._ready = self._propose_ahead(random, *state.coords.shape)
        solved = self._ready.pop()
        log_uniform = np.log(random.random_sample(len(state.coords)))
        with np.errstate(invalid="ignore"):
            log_ratio = (solved.log_density - solved.log_proposal) - (state.log_prob - state.blobs)
        accepted = solved.inside & (log_uniform < log_ratio)
        proposed = State(solved.points, log_prob=solved.log_density, blobs=solved.log_proposal)
        return self.update(state, proposed, accepted), accepted

    def _propose_ahead(self, random: Any, n_walkers: int, n: int) -> list[Solved]:
        total = self.ahead * n_walkers
        solved = self.atlas.propose(random.standard_normal((total, n)), random.random_sample(total))
        return [solved.take(slice(i, i + n_walkers)) for i in range(0, total, n_walkers)]
