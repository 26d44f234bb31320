"""Many runs of soft actor-critic trained as one: stacked networks, batched products, and every run on its own."""
