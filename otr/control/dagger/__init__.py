"""DAgger: the loop, the folder of a run, the rows that a fit sees, and the choice of an iterate."""
