"""What hyperplanes cut space into: regions, vertices, arrangements, and the minimal tree that follows from them."""
