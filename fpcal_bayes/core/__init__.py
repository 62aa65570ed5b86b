"""Files, times, errors and linear algebra: nothing here knows what a robot is."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {"errors": "InputError", "files": "read_text write_json write_text", "resources": "paper_tables"}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
