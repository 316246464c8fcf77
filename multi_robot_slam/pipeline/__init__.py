"""Events in, steps out: order messages by stamp, pair them into frames, step the filter."""
