"""A limit on the time of a call: set where the call begins, looked at in every loop below it.

The limit travels with the context, not as an argument, so that no function in between has to hand it on, and a limit
within another leaves that in force.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from otr.errors import TimeLimitError


class Clock:
    """Seconds that a call may take, and what it has reached."""

    def __init__(self, max_seconds: float, reached: Callable[[], str], outer: Clock | None) -> None:
        """Start; `reached` says in words how far the call came."""
        self.max_seconds, self.reached, self._outer = max_seconds, reached, outer
        self._began = time.monotonic()

    def check(self) -> None:
        """Raise TimeLimitError if this limit is met, or one around it."""
        seconds = time.monotonic() - self._began
        if seconds > self.max_seconds:
            raise TimeLimitError(
                f"the limit of {self.max_seconds:g} s was met after {seconds:.1f} s: {self.reached()}; raise the "
                "limit, or give a smaller domain"
            )
        if self._outer is not None:
            self._outer.check()

    def seconds_left(self) -> float:
        """Return the seconds up to the nearest limit; below 0 beyond it."""
        left = self.max_seconds - (time.monotonic() - self._began)
        return left if self._outer is None else min(left, self._outer.seconds_left())


_CLOCK: ContextVar[Clock | None] = ContextVar("clock", default=None)


@contextmanager
def time_limit(max_seconds: float | None, reached: Callable[[], str]) -> Iterator[None]:
    """Let everything that runs within take no longer than `max_seconds`; None is no limit.

    Raises:
        ValueError: the limit is below 0, or no number.
        TimeLimitError: the limit was met; the message says what `reached` returns.
    """
    if max_seconds is None:
        yield
        return
    if not max_seconds >= 0:
        raise ValueError(f"max_seconds is {max_seconds}, expected a number of at least 0, or None")
    token = _CLOCK.set(Clock(max_seconds, reached, _CLOCK.get()))
    try:
        yield
    finally:
        _CLOCK.reset(token)


def check_time() -> None:
    """Raise TimeLimitError where the time of a call is up; every loop that may be long calls this once a round."""
    clock = _CLOCK.get()
    if clock is not None:
        clock.check()


def seconds_left() -> float:
    """Return the seconds up to the nearest limit; infinite without one."""
    clock = _CLOCK.get()
    return math.inf if clock is None else clock.seconds_left()
