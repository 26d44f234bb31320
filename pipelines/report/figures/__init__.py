"""Figures of the thesis, of runs and of results."""
