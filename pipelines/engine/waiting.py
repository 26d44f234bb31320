"""How far a command is that takes long before it has something to print."""

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

PATIENCE_S = 1.5
T = TypeVar("T")


def counted(items: Sequence[T], what: str) -> Iterator[T]:
    """Give the items one by one; where that takes long, a terminal shows how many were given, until all were."""
    start, shown = time.monotonic(), False
    for number, item in enumerate(items):
        if sys.stderr.isatty() and time.monotonic() - start > PATIENCE_S:
            print(f"\r{what}: {number} of {len(items)}", end="", file=sys.stderr, flush=True)
            shown = True
        yield item
    if shown:
        print("\r\033[K", end="", file=sys.stderr, flush=True)
