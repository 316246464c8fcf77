"""Compiled code of the smoothing: plain loops over arrays."""
