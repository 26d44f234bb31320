"""Progress of fits that take long: a line every ten seconds."""

import time

from pipelines.engine.console import duration
from pipelines.supervised.config import FitConfig

EVERY_S = 10.0


class FitProgress:
    """Says how far something is, at most every ten seconds; call it with what is done and what there is."""

    def __init__(self, config: FitConfig, what: str, unit: str) -> None:
        self._prefix = f"{config.data.name} {config.method.name}: " if config.side_by_side else ""
        self._what, self._unit = what, unit
        self._began = self._said = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        """Report `done` of `total` units."""
        now = time.monotonic()
        if now - self._said < EVERY_S:
            return
        self._said, spent = now, now - self._began
        left = duration(spent / done * (total - done)) if done else "?"
        print(
            f"{self._prefix}{self._what}: {done:,} of {total:,} {self._unit}, {duration(spent)}, about {left} left",
            flush=True,
        )
