"""Which sweeps to measure."""
