"""Trees that are networks: many small ones trained as one batched model, labels x seeds."""
