"""Measurements of this project against numpy, torch and Stable-Baselines3; `python -m benchmarks --help` says how.

Every benchmark is a module with `measure(quick) -> list[Entry]`. Importing `pipelines` first limits BLAS and OpenMP to
one thread, before numpy and torch are imported.
"""

import pipelines  # noqa: F401
