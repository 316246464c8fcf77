"""What a run left: load it, save it, judge it, compare it, export it."""
