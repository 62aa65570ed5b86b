"""What was measured, in memory: sweeps, traces, truths and campaigns."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "PROTOCOLS": "protocol",
    "Sweeps": "sweeps",
    "Trace": "traces",
    "TraceIndex": "recordings",
    "Truth": "truth",
    "drive_of_sweeps": "sharing",
    "join": "sweeps",
    "paper_protocol": "protocol",
    "paper_truth": "truth",
    "pool": "sweeps",
    "protocol_by_name": "protocol",
    "read_often": "protocol",
    "single_sweep": "protocol",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
