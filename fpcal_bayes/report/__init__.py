"""Words, tables and figures; computes nothing."""
