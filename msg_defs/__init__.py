"""The vocabulary every other package speaks: types, topics, settings and wire formats."""
