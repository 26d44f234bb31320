"""Environments side by side, for training: gymnasium's own, EnvPool's, and plants in numpy, behind one interface."""
