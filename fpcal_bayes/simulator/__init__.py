"""The simulated cell: sweeps, recordings, optics."""
