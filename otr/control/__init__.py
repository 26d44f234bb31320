"""Trees from interaction: by imitation or by policy gradient, each of which ends in an `ObliqueTree`."""
