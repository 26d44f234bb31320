"""Environments side by side, for training: gymnasium's own, and plants in numpy, behind one interface."""
