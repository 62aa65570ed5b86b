"""The geometric model: parameters, cell, chain, cavity, estimate."""
