"""The time left of a command, estimated from what is done, as text."""

import time
from collections.abc import Callable

from pipelines.engine.console import duration

EVERY_S = 10.0
MEASURED_S = 3.0  # of learning, before the time left is printed


def time_left(seconds: float | None) -> str:
    """Return the estimated time left as text; None is while it is being measured."""
    return "measuring" if seconds is None else f"{duration(seconds)} left"


def progress_lines(what: str, unit: str) -> Callable[[int, int], None]:
    """Return a function that prints how much is done, at most every ten seconds, with the time left."""
    began = said = time.monotonic()

    def say(done: int, total: int) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said >= EVERY_S:
            said, spent = now, now - began
            left = time_left(spent / done * (total - done)) if done else "? left"
            print(f"{what}: {done:,} of {total:,} {unit}, {duration(spent)}, about {left}", flush=True)

    return say


class Pace:
    """How long a step takes, measured from the first that learns: the random ones before it are ten times as fast.

    Whole rollouts count, with their updates, and the evaluations between them.
    """

    def __init__(self, first_step: int, rollout_steps: int) -> None:
        self._first_step, self._rollout_steps = first_step, rollout_steps
        self._start: tuple[int, float] | None = None
        self._last = -1
        self._n_steps, self._seconds = 0, 0.0

    def at_step(self, step: int, now: float) -> None:
        """Record the time of a step, in seconds; its update follows, and is done by the next call."""
        is_over, self._last = step == self._last, step
        if self._start is None:
            self._start = (step, now) if step >= self._first_step else None
            return
        n_learnt = step - self._start[0] - (not is_over)
        n_steps = n_learnt // self._rollout_steps * self._rollout_steps
        if n_steps > self._n_steps or is_over:
            self._n_steps, self._seconds = n_steps, now - self._start[1]

    def seconds(self, n_steps: int) -> float | None:
        """Return how long so many steps take; None while that is being measured."""
        if not self._n_steps or self._seconds < MEASURED_S:
            return None
        return n_steps * self._seconds / self._n_steps
