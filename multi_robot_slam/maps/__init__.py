"""Files that last: maps and the state of a filter in a container that NumPy alone reads."""
