"""Questions that need many replicates, and the paper's week."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "base": "drawn_truth",
    "paper_week": "SESSIONS measure_week",
    "sbc": "FAMILY_WISE PROTOCOLS PosteriorRanks RANKED quantities sbc_plan",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
