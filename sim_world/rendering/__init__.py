"""Rendered cameras: what a robot's stereo pair shows of the building."""
