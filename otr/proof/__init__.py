"""Proofs about trees: certificates of equality with a network, bounds on actions, conditions that always hold."""
