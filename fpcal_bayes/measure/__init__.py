"""What was measured, in memory: sweeps, traces, truths and campaigns."""
