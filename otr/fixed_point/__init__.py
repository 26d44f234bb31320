"""Trees in fixed point: rounded, proved, and of the shortest words that a proof allows."""
