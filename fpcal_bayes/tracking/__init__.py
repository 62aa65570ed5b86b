"""The parameters from session to session."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "DriftModel": "drift",
    "Limits": "alarms",
    "LinearMeasurement": "measurement",
    "SessionOutcome": "session",
    "State": "drift",
    "SweepMeasurement": "measurement",
    "Track": "tracker",
    "calibrate": "tracker",
    "estimate_of": "tracker",
    "follow_sessions": "smoother",
    "followed_drift": "session",
    "likely_terms": "drift",
    "predict": "filter",
    "propagated": "drift",
    "smooth": "smoother",
    "take_in": "session",
    "track": "tracker",
    "update": "filter",
    "with_learnt_pace": "fit_sizes",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
