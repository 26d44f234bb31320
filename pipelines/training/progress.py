"""Progress of long training: a bar in a terminal that is not shared, and a line a segment with speed and time left."""

import sys
import time
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn

from pipelines.engine.time_left import Pace, time_left
from pipelines.training.estimates import learning_starts
from pipelines.training.settings import TrainSettings

REFRESH_S = 0.25


class TrainingDisplay:
    """Shows the training of one run or of several, of which `config` is the first's; a context manager.

    `prefix` begins each line, `shown` follows the bar, `done_steps` of the `n_steps` were done before, and those
    from `first_learning_step` on learn.
    """

    def __init__(
        self,
        config: TrainSettings,
        prefix: str,
        n_steps: int,
        done_steps: int,
        first_learning_step: int,
        shown: ProgressColumn | None = None,
    ) -> None:
        self.n_steps, self._prefix, self._done_steps = n_steps, prefix, done_steps
        self._pace = Pace(first_learning_step, 1 if config.fleet else config.algo.rollout_steps)
        self._last = 0.0
        self.bar: Progress | None = None
        if sys.stdout.isatty() and not config.side_by_side:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                shown or MofNCompleteColumn(),
                TextColumn("{task.fields[left]}"),
            )
            self.bar = Progress(*columns, console=Console(highlight=False), transient=True)
            self._task = self.bar.add_task("train", total=n_steps, completed=done_steps, left="")

    def __enter__(self) -> Self:
        if self.bar:
            self.bar.start()
        self.at_step(self._done_steps)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self.bar:
            self.bar.stop()

    def at_step(self, step: int) -> None:
        """Record an environment step and move the bar; cheap when the last call was a moment ago."""
        now = time.monotonic()
        self._pace.at_step(step, now)
        if self.bar and now - self._last > REFRESH_S:
            self._last = now
            self.bar.update(self._task, completed=min(step, self.n_steps), left=self.time_left(self.n_steps - step))

    def time_left(self, n_steps: int) -> str:
        """Return the likely time of so many steps, as readable text."""
        return time_left(self._pace.seconds(n_steps) if n_steps > 0 else 0.0)

    def say(self, line: str) -> None:
        """Print a line, above the bar where there is one."""
        if self.bar:
            self.bar.console.print(f"{self._prefix}{line}", highlight=False)
        else:
            print(f"{self._prefix}{line}", flush=True)


class TrainingProgress(TrainingDisplay):
    """Shows one training run; among jobs side by side its lines begin with the job's name."""

    def __init__(self, config: TrainSettings, done_steps: int) -> None:
        digest = "".join(config.folder.partition("~")[1:])  # of other settings
        job = f"{config.env.name} depth {config.depth} seed {config.seed}{digest}: " if config.side_by_side else ""
        super().__init__(config, f"{job}train: ", config.train.steps, done_steps, learning_starts(config))
        if done_steps:
            self.say(f"going on from step {done_steps:,} of {self.n_steps:,}")

    def segment_done(self, progress: dict[str, Any], evaluation: dict[str, Any]) -> None:
        """Show the speed and the evaluation of a segment, and the time left."""
        steps = progress["steps"]
        mark = " (best so far)" if evaluation["best"] else ""
        self.at_step(steps)
        self.say(
            f"step {steps:,}/{max(steps, self.n_steps):,}  {progress['steps_per_s']:,.0f} steps/s  "
            f"{self.time_left(self.n_steps - steps)}  return {evaluation['return_mean']:.1f}{mark}"
        )
