"""Least squares over whole paths: given who saw what, the most likely poses and landmarks."""
