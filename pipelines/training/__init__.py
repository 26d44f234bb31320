"""Actors trained: by Stable-Baselines3, by a fleet of our own, by random search; with checkpoints and progress."""
