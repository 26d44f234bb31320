"""Runs as a whole: their stages in order, what is left to do, and what is done with finished ones."""
