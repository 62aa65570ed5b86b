"""The parameters from session to session."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "alarms": "Limits",
    "drift": "DriftModel State likely_terms propagated",
    "filter": "predict update",
    "fit_sizes": "with_learnt_pace",
    "measurement": "LinearMeasurement SweepMeasurement",
    "session": "SessionOutcome followed_drift take_in",
    "smoother": "follow_sessions smooth",
    "tracker": "Track calibrate estimate_of track",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
