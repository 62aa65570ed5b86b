"""Results that several commands show: a campaign with its history, the doctor's findings, rows of whole traces."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room that cost much to load, and the names of each that are used outside it.
_PLACES = {"traces": "trace_rows"}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
