"""Progress of a fleet: a line a segment, with the speed of all runs together and the time left."""

from collections.abc import Sequence

from rich.progress import TextColumn

from pipelines.engine.job import message_of
from pipelines.training.estimates import learning_starts
from pipelines.training.fleet.fleet_run import FleetRun
from pipelines.training.progress import TrainingDisplay


class FleetProgress(TrainingDisplay):
    """Shows a fleet's training."""

    def __init__(self, runs: Sequence[FleetRun]) -> None:
        self._runs, config = list(runs), runs[0].config
        prefix = f"train: {config.env.name}, {len(runs)} run{'s' if len(runs) > 1 else ''}: "
        n_steps = sum(run.config.train.steps for run in runs)
        done = [run.n_steps for run in runs]
        first = sum(max(n, learning_starts(run.config)) for n, run in zip(done, runs, strict=True))
        super().__init__(config, prefix, n_steps, sum(done), first, TextColumn("{task.percentage:.0f} %"))
        if any(done):
            self.say(f"going on from step {min(done):,}" + (f" to {max(done):,}" if max(done) > min(done) else ""))

    def at_more_steps(self, n_more: int) -> None:
        """Move the bar to `n_more` steps, of all runs together, after the last whole segment."""
        self.at_step(sum(run.n_steps for run in self._runs) + n_more)

    def segment_done(self, cohort: Sequence[FleetRun], start: int, seconds: float) -> None:
        """Show the results of a segment of some runs, which began at step `start`."""
        config = cohort[0].config
        n_steps = sum(run.n_steps - start for run in cohort)
        self.at_more_steps(0)
        left = sum(max(0, run.config.train.steps - run.n_steps) for run in self._runs if run.error is None)
        going = [run for run in cohort if run.error is None]
        returns = [run.history.evaluations[-1]["return_mean"] for run in going]
        best = [max(row["return_mean"] for row in run.history.evaluations) for run in going]
        shown = f"  returns {_range(returns)}, best {_range(best)}" if going else ""
        self.say(
            f"step {cohort[0].n_steps:,}/{config.train.steps:,}  {n_steps / seconds:,.0f} steps/s in all  "
            f"{self.time_left(left)}{shown}"
        )

    def give_up(self, run: FleetRun, error: Exception) -> None:
        """Abandon a run, and report it."""
        run.error = error
        others = ", the others go on" if len(self._runs) > 1 else ""
        self.say(f"{run.name} abandoned{others}: {message_of(error)}")


def _range(values: Sequence[float]) -> str:
    return f"{values[0]:.1f}" if len(values) == 1 else f"{min(values):.1f} to {max(values):.1f}"
