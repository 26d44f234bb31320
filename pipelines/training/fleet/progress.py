"""Progress of a fleet: a line a segment, with the speed of all runs together and the time left."""

import sys
import time
from collections.abc import Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from pipelines.engine.console import duration
from pipelines.training.estimates import learning_starts, training_rate
from pipelines.training.fleet.fleet_run import FleetRun

REFRESH_S = 0.25


class FleetProgress:
    """Shows a fleet's training; a context manager. A bar in a terminal that is not shared, lines in any case."""

    def __init__(self, runs: Sequence[FleetRun]) -> None:
        self._runs, config = list(runs), runs[0].config
        self._prefix = f"{config.env.name}, {len(runs)} run{'s' if len(runs) > 1 else ''}: "
        self._seconds, self._steps = 0.0, 0  # of segments that learn all the way
        self._last = 0.0
        self._bar: Progress | None = None
        if sys.stdout.isatty() and not config.side_by_side:
            columns = TextColumn("train"), BarColumn(), TextColumn("{task.percentage:.0f} %"), TimeRemainingColumn()
            self._bar = Progress(*columns, console=Console(highlight=False), transient=True)
            self._task = self._bar.add_task("train", total=sum(run.config.train.steps for run in runs))
        done = [run.n_steps for run in runs]
        if any(done):
            self._say(f"going on from step {min(done):,}" + (f" to {max(done):,}" if max(done) > min(done) else ""))

    def __enter__(self) -> "FleetProgress":
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._bar:
            self._bar.stop()

    def at_step(self, n_more: int) -> None:
        """Move the bar to `n_more` steps, of all runs together, after the last whole segment; cheap when too soon."""
        now = time.monotonic()
        if self._bar and now - self._last > REFRESH_S:
            self._last = now
            self._bar.update(self._task, completed=sum(run.n_steps for run in self._runs) + n_more)

    def segment_done(self, cohort: Sequence[FleetRun], start: int, seconds: float) -> None:
        """Show what a segment of some runs, which began at step `start`, came to."""
        config = cohort[0].config
        n_steps = sum(run.n_steps - start for run in cohort)
        if start >= learning_starts(config):
            self._seconds += seconds
            self._steps += n_steps
        rate = self._steps / self._seconds if self._steps else training_rate(config)
        left = sum(max(0, run.config.train.steps - run.n_steps) for run in self._runs if run.error is None)
        going = [run for run in cohort if run.error is None]
        returns = [run.history.evaluations[-1]["return_mean"] for run in going]
        best = [max(row["return_mean"] for row in run.history.evaluations) for run in going]
        shown = f"  returns {_range(returns)}, best {_range(best)}" if going else ""
        self._say(
            f"step {cohort[0].n_steps:,}/{config.train.steps:,}  {n_steps / seconds:,.0f} steps/s in all  "
            f"{duration(left / rate)} left{shown}"
        )

    def given_up(self, run: FleetRun) -> None:
        """Tell that a run is left behind."""
        self._say(f"{run.name} given up, the others go on: {run.error}")

    def _say(self, line: str) -> None:
        line = f"train: {self._prefix}{line}"
        if self._bar:
            self._bar.console.print(line, highlight=False)
        else:
            print(line, flush=True)


def _range(values: Sequence[float]) -> str:
    return f"{values[0]:.1f}" if len(values) == 1 else f"{min(values):.1f} to {max(values):.1f}"
