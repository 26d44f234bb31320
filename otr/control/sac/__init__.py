"""Soft actor-critic of many runs as one learner: stacked networks, batched products, and every run on its own."""
