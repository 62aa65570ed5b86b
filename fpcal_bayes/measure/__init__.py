"""What was measured, in memory: sweeps, traces, truths and campaigns."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "protocol": "PROTOCOLS paper_protocol protocol_by_name read_often single_sweep",
    "recordings": "TraceIndex",
    "sharing": "drive_of_sweeps",
    "sweeps": "Sweeps join pool",
    "traces": "Trace",
    "truth": "Truth paper_truth",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
