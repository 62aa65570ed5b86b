"""Which sweeps to measure: fewer of them for the same accuracy of the tasks (Bayesian experimental design)."""
