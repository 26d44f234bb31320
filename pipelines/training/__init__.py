"""Actors trained: by Stable-Baselines3, by our fleet, by random search; with checkpoints and progress."""
