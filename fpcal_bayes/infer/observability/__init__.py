"""What sweeps can tell: rank, gauges, information, bounds."""
