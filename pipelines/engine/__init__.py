"""Stages, jobs, sweeps and their store: knows nothing of policies."""
