"""Runs logged to TensorBoard while they train; tracking is write-only and never affects a run."""
