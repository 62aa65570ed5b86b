"""A calibration judged by sweeps that it was not made from."""
