"""Bayesian calibration of micro- and nano-positioning robots from one-dimensional Fabry-Perot measurements."""

__version__ = "0.1.0"
