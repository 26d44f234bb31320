"""What commands show in a terminal: numbers, and how far a command is before it has something to print."""

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

PATIENCE_S = 1.5
SHORT_PROGRAM = 40  # lines; a longer one is named, not shown
T = TypeVar("T")


def duration(seconds: float) -> str:
    """Return seconds as people read them: 45 s, 12 min, 3.5 h."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


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
