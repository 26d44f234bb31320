"""A tree as a picture; matplotlib is loaded when one is drawn."""
