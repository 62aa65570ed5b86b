"""Inference on a machine with error motions: weights marginalised, scales sampled, doubts by name."""
