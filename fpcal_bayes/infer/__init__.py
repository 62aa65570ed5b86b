"""What the data say: fit, observability, posterior, task errors, and the design of sweeps."""
