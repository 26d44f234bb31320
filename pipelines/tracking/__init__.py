"""Runs logged to TensorBoard or MLflow while they train; tracking is write-only and never affects a run."""
