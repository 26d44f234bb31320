"""Environments, episodes in them, and the comparison of what two policies do."""
