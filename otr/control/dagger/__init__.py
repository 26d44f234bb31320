"""DAgger: the loop, its aggregated data, the rows that a fit sees, and the choice of an iterate."""
