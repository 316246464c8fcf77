"""Recordings in other formats -> bags of this project's topics."""
