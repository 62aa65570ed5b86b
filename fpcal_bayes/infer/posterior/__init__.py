"""Sampling the posterior: exact, converged, resumable; and comparison of models."""
