"""Denormal numbers, on which arithmetic is ten times slower, taken as zero while networks train."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def denormals_as_zero() -> Iterator[None]:
    """Take float32 numbers below 1e-38 and float64 numbers below 2e-308 as zero, in this thread.

    A rare input's momentum and a decayed weight get there, where they are worth nothing. Never for a whole process:
    exact proofs compute with denormal numbers, and whatever is trained must not depend on what was imported.
    """
    before = not (torch.tensor([1e-39]) * 1.0).any()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
