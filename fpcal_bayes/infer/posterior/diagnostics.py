"""Has the sampling converged? Measures over independent ensembles, and what to say where the answer is no."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats

MOST_RHAT = 1.01
LEAST_LENGTH = 50
#: Ends of the interval whose quantiles the tail size is for.
_TAIL = (0.05, 0.95)


@dataclass(frozen=True)
class Diagnostics:
    """Convergence of draws of several ensembles."""

    rhat: Floats  # nested, the ensembles being the superchains (Margossian et al. 2024), shape (n,)
    ess_bulk: Floats  # effective size (Vehtari et al. 2021), shape (n,)
    ess_tail: Floats  # likewise
    autocorrelation_time: float  # longest over the parameters, in steps
    length: int  # steps of each walker

    @property
    def effective(self) -> float:
        """Smallest effective size of any parameter, in the bulk and in the tails."""
        return float(min(self.ess_bulk.min(), self.ess_tail.min()))

    def failures(self, draws: int) -> list[str]:
        """Sentences on what is not reached yet; none if the draws can be used."""
        failures = []
        if not float(self.rhat.max()) < MOST_RHAT:
            failures.append(f"nested R-hat {self.rhat.max():.3f}, expected below {MOST_RHAT}")
        if self.effective < draws:
            failures.append(f"{self.effective:.0f} effective draws of the worst parameter, expected {draws}")
        if self.length < LEAST_LENGTH * self.autocorrelation_time:
            failures.append(
                f"{self.length} steps of {self.autocorrelation_time:.1f} steps autocorrelation, expected "
                f"{LEAST_LENGTH} times as many"
            )
        return failures


def diagnose(draws: Floats) -> Diagnostics:
    """Diagnose draws of shape (n_ensembles, n_steps, n_walkers, n)."""
    # Importing arviz takes long: only where it is used.
    from arviz_stats.base import array_stats

    n_ensembles, n_steps, n_walkers, n = draws.shape
    chains = draws.transpose(0, 2, 1, 3).reshape(n_ensembles * n_walkers, n_steps, n)
    superchain = np.repeat(np.arange(n_ensembles), n_walkers)
    layout = {"chain_axis": 0, "draw_axis": 1}
    mean_size = np.asarray(array_stats.ess(chains, method="mean", **layout))
    return Diagnostics(
        rhat=np.asarray(array_stats.rhat_nested(chains, superchain, **layout)),
        ess_bulk=np.asarray(array_stats.ess(chains, method="bulk", **layout)),
        ess_tail=np.asarray(array_stats.ess(chains, method="tail", prob=_TAIL, **layout)),
        autocorrelation_time=float(chains.shape[0] * n_steps / mean_size.min()),
        length=n_steps,
    )
