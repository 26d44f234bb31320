"""Networks, trees, the exact map from one to the other, pruning, and both on disk: numpy alone."""
