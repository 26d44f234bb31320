"""Progress of long training: a bar with steps/s and time left in a terminal, a line per segment otherwise."""

import sys
import time
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from stable_baselines3.common.callbacks import BaseCallback

from pipelines.config import RunConfig
from pipelines.engine.console import duration
from pipelines.training.estimates import learning_starts

REFRESH_S = 0.25


class TrainingProgress:
    """Shows one training run; a context manager.

    `callbacks` are for the model's `learn`, none without a terminal. Jobs side by side share a terminal: they get lines
    that begin with the job's name instead of a bar.
    """

    def __init__(self, config: RunConfig, done_steps: int) -> None:
        self.n_steps = config.train.steps
        self._prefix = f"{config.env.name} depth {config.depth} seed {config.seed}: " if config.side_by_side else ""
        self._first_learning_step = max(done_steps, learning_starts(config))
        self._steps, self._seconds = 0, 0.0  # of whole segments that learn all the way
        self._expected_rate = config.algo.steps_per_s
        self._bar = _bar() if sys.stdout.isatty() and not config.side_by_side else None
        self._task = self._bar.add_task("train", total=self.n_steps, completed=done_steps) if self._bar else None
        self.callbacks = [_Refresh(self)] if self._bar else []
        if done_steps:
            self._say(f"going on from step {done_steps:,} of {self.n_steps:,}")

    def __enter__(self) -> "TrainingProgress":
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._bar:
            self._bar.stop()

    def at_step(self, step: int) -> None:
        """Move the bar to an environment step."""
        if self._bar and self._task is not None:
            self._bar.update(self._task, completed=min(step, self.n_steps))

    def segment_done(self, start: int, progress: dict[str, Any], evaluation: dict[str, Any]) -> None:
        """Show the speed and the evaluation of the segment that began at step `start`, and the time left."""
        steps = progress["steps"]
        if start >= self._first_learning_step:
            self._steps += steps - start
            self._seconds += progress["seconds"]
        rate = self._steps / self._seconds if self._steps else self._expected_rate
        left = duration(max(0, self.n_steps - steps) / rate)
        mark = " (best so far)" if evaluation["best"] else ""
        self.at_step(steps)
        self._say(
            f"step {steps:,}/{self.n_steps:,}  {progress['steps_per_s']:,.0f} steps/s  {left} left  "
            f"return {evaluation['return_mean']:.1f}{mark}"
        )

    def _say(self, line: str) -> None:
        if self._bar:
            self._bar.console.print(f"train: {line}", highlight=False)
        else:
            print(f"{self._prefix}train: {line}", flush=True)


def _bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(highlight=False),
        transient=True,
    )


class _Refresh(BaseCallback):
    """Moves the bar a few times a second."""

    def __init__(self, progress: TrainingProgress) -> None:
        super().__init__()
        self._progress = progress
        self._last = 0.0

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self._last > REFRESH_S:
            self._last = now
            self._progress.at_step(self.num_timesteps)
        return True
