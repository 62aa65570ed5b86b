"""The fit to whole traces."""
