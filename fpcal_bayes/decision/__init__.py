"""Hold, re-identify or recalibrate."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "closed_loop": "Sessions run_policy run_rule task_peaks",
    "decision": "Costs",
    "diagnosis": "is_diagnosis",
    "forecast": "Forecaster Goal",
    "policy": "Policy valid_until",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
