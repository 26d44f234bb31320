"""Trees written out as programs, read from them, and drawn."""
