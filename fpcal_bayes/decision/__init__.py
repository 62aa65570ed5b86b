"""Hold, re-identify or recalibrate."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "Costs": "decision",
    "Forecaster": "forecast",
    "Goal": "forecast",
    "Policy": "policy",
    "Sessions": "closed_loop",
    "is_diagnosis": "diagnosis",
    "run_policy": "closed_loop",
    "run_rule": "closed_loop",
    "task_peaks": "closed_loop",
    "valid_until": "policy",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
