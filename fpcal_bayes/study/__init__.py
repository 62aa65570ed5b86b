"""Questions that need many replicates, on this machine or on a cluster, and the paper's week."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "DriftingWeek": "drifting_week",
    "FAMILY_WISE": "sbc",
    "MakeRule": "policies",
    "PROTOCOLS": "sbc",
    "PosteriorRanks": "sbc",
    "RANKED": "sbc",
    "Rule": "drifting_week",
    "Run": "drifting_week",
    "SESSIONS": "paper_week",
    "STEP": "drifting_week",
    "Setting": "drifting_week",
    "check_circle": "policies",
    "compare": "planning",
    "drawn_truth": "base",
    "fixed": "policies",
    "follow": "drifting_week",
    "largest_errors": "planning",
    "measure_week": "paper_week",
    "never": "policies",
    "ours": "policies",
    "quantities": "sbc",
    "sbc_plan": "sbc",
    "simulate_week": "drifting_week",
    "translations": "policies",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
