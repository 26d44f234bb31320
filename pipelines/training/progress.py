"""Progress of long training: a bar in a terminal that is not shared, and a line a segment with speed and time left."""

import sys
import time
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from pipelines.config.run import RunConfig
from pipelines.engine.console import duration
from pipelines.training.estimates import learning_starts, training_rate

REFRESH_S = 0.25


class TrainingDisplay:
    """Shows the training of one run or of several, of which `config` is the first's; a context manager.

    `prefix` begins each line, `shown` stands beside the bar, `done_steps` of the `n_steps` were done before.
    """

    def __init__(
        self, config: RunConfig, prefix: str, n_steps: int, done_steps: int, shown: ProgressColumn | None = None
    ) -> None:
        self.n_steps, self._prefix = n_steps, prefix
        self._steps, self._seconds = 0, 0.0  # of segments that learn all the way
        self._expected_rate = training_rate(config)
        self._last = 0.0
        self.bar: Progress | None = None
        if sys.stdout.isatty() and not config.side_by_side:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                shown or MofNCompleteColumn(),
                TimeRemainingColumn(),
            )
            self.bar = Progress(*columns, console=Console(highlight=False), transient=True)
            self._task = self.bar.add_task("train", total=n_steps, completed=done_steps)

    def __enter__(self) -> Self:
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self.bar:
            self.bar.stop()

    def at_step(self, step: int) -> None:
        """Move the bar to an environment step; cheap when the last time was a moment ago."""
        now = time.monotonic()
        if self.bar and now - self._last > REFRESH_S:
            self._last = now
            self.bar.update(self._task, completed=min(step, self.n_steps))

    def learnt(self, n_steps: int, seconds: float) -> None:
        """Take in the speed of a segment that learnt all the way."""
        self._steps += n_steps
        self._seconds += seconds

    def time_left(self, n_steps: int) -> str:
        """Return the likely time of so many steps, as people read it."""
        rate = self._steps / self._seconds if self._steps else self._expected_rate
        return duration(max(0, n_steps) / rate)

    def say(self, line: str) -> None:
        """Print a line, above the bar where there is one."""
        if self.bar:
            self.bar.console.print(f"{self._prefix}{line}", highlight=False)
        else:
            print(f"{self._prefix}{line}", flush=True)


class TrainingProgress(TrainingDisplay):
    """Shows one training run; among jobs side by side its lines begin with the job's name."""

    def __init__(self, config: RunConfig, done_steps: int) -> None:
        job = f"{config.env.name} depth {config.depth} seed {config.seed}: " if config.side_by_side else ""
        super().__init__(config, f"{job}train: ", config.train.steps, done_steps)
        self._first_learning_step = max(done_steps, learning_starts(config))
        if done_steps:
            self.say(f"going on from step {done_steps:,} of {self.n_steps:,}")

    def segment_done(self, start: int, progress: dict[str, Any], evaluation: dict[str, Any]) -> None:
        """Show the speed and the evaluation of the segment that began at step `start`, and the time left."""
        steps = progress["steps"]
        if start >= self._first_learning_step:
            self.learnt(steps - start, progress["seconds"])
        mark = " (best so far)" if evaluation["best"] else ""
        self.at_step(steps)
        self.say(
            f"step {steps:,}/{self.n_steps:,}  {progress['steps_per_s']:,.0f} steps/s  "
            f"{self.time_left(self.n_steps - steps)} left  return {evaluation['return_mean']:.1f}{mark}"
        )
