"""Hold, re-identify or recalibrate."""
