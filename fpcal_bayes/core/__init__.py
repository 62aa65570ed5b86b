"""Files, times, errors and linear algebra: nothing here knows what a robot is."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "paper_tables": "resources",
    "read_text": "files",
    "write_json": "files",
    "write_text": "files",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
