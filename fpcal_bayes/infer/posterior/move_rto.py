"""emcee move: independent proposals from an atlas of charts."""

from typing import Any

import numpy as np
from emcee.moves import Move
from emcee.state import State

from fpcal_bayes.infer.posterior.atlas import Atlas


class RandomiseThenOptimiseMove(Move):  # type: ignore[misc]
    """Metropolis-Hastings with independent proposals from an atlas.

    Each walker carries the log density with which the atlas proposes its place (the blob), so that the step is exact
    also for walkers outside every chart: from there any move inside is refused, as none leads back. Another move has to
    bring them in and out.
    """

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas

    def propose(self, model: Any, state: State) -> tuple[State, Any]:
        """Move every walker once."""
        random = model.random
        solved = self.atlas.propose(random.standard_normal(state.coords.shape), random.random_sample(len(state.coords)))
        log_uniform = np.log(random.random_sample(len(state.coords)))
        with np.errstate(invalid="ignore"):
            log_ratio = (solved.log_density - solved.log_proposal) - (state.log_prob - state.blobs)
        accepted = solved.inside & (log_uniform < log_ratio)
        proposed = State(solved.points, log_prob=solved.log_density, blobs=solved.log_proposal)
        return self.update(state, proposed, accepted), accepted
