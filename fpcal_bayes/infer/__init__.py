"""Inference: from sweeps to estimates, and what the sweeps can tell."""
