"""Devices: motion controllers, interferometers and photodiodes, one file each behind one interface."""
