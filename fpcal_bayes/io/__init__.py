"""Every file format: readers and writers of what `model` and `measure` define."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {"cell": "load_cell", "recordings": "read_recordings", "sweeps": "read_sweeps write_csv write_sweeps"}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
