"""What a run is asked to do: frozen dataclasses, one module per group of conf/, independent of Hydra."""
