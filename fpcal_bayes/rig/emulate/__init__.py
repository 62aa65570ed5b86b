"""Emulated devices: one simulated cell behind real protocols, on loopback."""
