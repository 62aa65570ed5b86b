"""Every file format: readers and writers of what `model` and `measure` define."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "load_cell": "cell",
    "read_recordings": "recordings",
    "read_sweeps": "sweeps",
    "write_csv": "sweeps",
    "write_sweeps": "sweeps",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
