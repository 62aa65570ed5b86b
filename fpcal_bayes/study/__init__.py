"""Questions that need many replicates, and the paper's week."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "FAMILY_WISE": "sbc",
    "PROTOCOLS": "sbc",
    "PosteriorRanks": "sbc",
    "RANKED": "sbc",
    "SESSIONS": "paper_week",
    "drawn_truth": "base",
    "measure_week": "paper_week",
    "quantities": "sbc",
    "sbc_plan": "sbc",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
