"""Shared by all tests: one thread for BLAS and torch, set before anything imports them; and hypothesis's settings."""

import os

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from hypothesis import settings  # noqa: E402

# Never a deadline: a slow machine is no failure. New examples at every run, but the same ones where CI=true is set, so
# that what passed passes again; --hypothesis-profile=thorough (make test-all) looks at many more.
settings.register_profile("new", deadline=None)
settings.register_profile("same", deadline=None, derandomize=True, print_blob=True)
settings.register_profile("thorough", deadline=None, max_examples=1000)
settings.load_profile("same" if os.environ.get("CI") else "new")
