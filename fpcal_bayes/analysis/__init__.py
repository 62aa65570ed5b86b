"""Results that several commands show: a campaign with its history, the doctor's findings, rows of whole traces."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the room and cost much to load, and the module of the room in which each stands.
_PLACES = {"trace_rows": "traces"}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
