"""The simulated cell: sweeps, recordings, optics."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "machine": "Machine MachineSettings",
    "optics": "RecorderSettings",
    "recorder": "record_sweeps",
    "sweeps": "noise_free simulate_um",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
