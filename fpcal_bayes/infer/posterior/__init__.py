"""Sampling the posterior: exact, converged, resumable."""
