"""Files, times, errors and linear algebra: nothing here knows what a robot is."""
