"""Progress of long training: a bar with steps/s and time left in a terminal, a line per segment otherwise."""

import sys
import time
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from stable_baselines3.common.callbacks import BaseCallback

from pipelines.console import duration

REFRESH_S = 0.25


class TrainingProgress:
    """Shows one training run; a context manager. `callback` is for the model's `learn`, None without a terminal."""

    def __init__(self, n_steps: int, done_steps: int) -> None:
        self.n_steps = n_steps
        self._resumed_at = done_steps
        self._bar = _bar() if sys.stdout.isatty() else None
        self._task = self._bar.add_task("train", total=n_steps, completed=done_steps, note="") if self._bar else None
        self.callback = _Refresh(self) if self._bar else None
        self._seconds = 0.0
        if done_steps:
            self._say(f"train: going on from step {done_steps:,} of {n_steps:,}")

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

    def segment_done(self, progress: dict[str, Any], evaluation: dict[str, Any]) -> None:
        """Show a segment's speed and evaluation."""
        self._seconds += progress["seconds"]
        steps, rate = progress["steps"], progress["steps_per_s"]
        average = (steps - self._resumed_at) / self._seconds
        left_s = max(0, self.n_steps - steps) / average
        mark = " (best so far)" if evaluation["best"] else ""
        note = f"return {evaluation['return_mean']:.1f}{mark}"
        if self._bar and self._task is not None:
            self._bar.update(self._task, completed=min(steps, self.n_steps), note=f"{rate:,.0f} steps/s  {note}")
        else:
            self._say(f"train: step {steps:,}/{self.n_steps:,}  {rate:,.0f} steps/s  {duration(left_s)} left  {note}")

    def _say(self, line: str) -> None:
        if self._bar:
            self._bar.console.print(line, highlight=False)
        else:
            print(line, flush=True)


def _bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
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
