"""From recorded irradiance to changes of length, and to the error along a path."""
