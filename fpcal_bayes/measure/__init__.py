"""Measurements: sweeps, protocols, campaign files, a simulated cell."""
