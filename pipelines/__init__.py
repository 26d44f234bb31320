"""The staged commands: train, map, prune, evaluate and tabulate, each a pure function keyed by its inputs."""

import os

# Two BLAS or OpenMP threads per process slow small networks down by two orders of magnitude. The variables are read
# when numpy and torch are first imported, so they are set here, before any module of this package can import them.
for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
