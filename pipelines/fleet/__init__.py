"""The fleet: many runs of one environment trained as one batched program."""
