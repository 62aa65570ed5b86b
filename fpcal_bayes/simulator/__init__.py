"""The simulated cell: sweeps, recordings, optics."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "Machine": "machine",
    "MachineSettings": "machine",
    "RecorderSettings": "optics",
    "noise_free": "sweeps",
    "record_sweeps": "recorder",
    "simulate_um": "sweeps",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
