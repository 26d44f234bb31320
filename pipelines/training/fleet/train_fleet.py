"""Training many runs of one environment as one: collect, update, evaluate, checkpoint, segment by segment.

As in `pipelines/training/sb3/training.py` a segment is the steps between two evaluations and starts with new
environments and random streams that the run and the segment alone decide. So a killed and resumed run equals an
uninterrupted one, and a run equals itself whatever runs it was trained with, bit for bit on one type of processor with
the same package versions (between two types float32 rounds differently, and training multiplies the difference).
"""

import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import torch

from pipelines.engine.job import message_of
from pipelines.errors import PipelineError
from pipelines.play.selection import diverged
from pipelines.training.checkpoints import progress_row
from pipelines.training.critics import critics_file
from pipelines.training.fleet.fleet_run import FleetRun
from pipelines.training.fleet.progress import FleetProgress
from pipelines.training.fleet.trainer import EnvironmentFailed, FleetTrainer, Task
from pipelines.training.settings import TrainSettings


def train_fleet(
    configs: Sequence[TrainSettings], checkpoints: Sequence[Path], outs: Sequence[Path]
) -> list[Exception | None]:
    """Train runs that are one fleet as one, each from its own checkpoint; write each one's result into its folder.

    Runs that are behind the others catch up first; a run that diverges, or whose environment fails, is abandoned.

    Returns:
        For each run None, or why it has no result: the training diverged or its checkpoint is damaged (PipelineError),
        the exported network and the trained policy disagree on a visited state (PolicyMismatchError), or what its
        environment raised.
    """
    task = Task.of(configs[0])
    opened = [_opened(config, folder, task) for config, folder in zip(configs, checkpoints, strict=True)]
    runs = [run for run in opened if isinstance(run, FleetRun)]
    if runs:
        with FleetProgress(runs) as progress:
            while cohort := _cohort(runs):
                try:
                    with closing(FleetTrainer(task, cohort)) as trainer:
                        while _cohort(runs) == cohort:
                            _segment(trainer, progress)
                except EnvironmentFailed as failed:
                    _without_the_failing(failed, task, cohort, progress)
    for run, out in zip(opened, outs, strict=True):
        if isinstance(run, FleetRun) and run.error is None:
            run.history.write(out)
    return [run.error if isinstance(run, FleetRun) else run for run in opened]


def _opened(config: TrainSettings, folder: Path, task: Task) -> FleetRun | PipelineError:
    """Return a run as of its checkpoint, or what is wrong with that."""
    try:
        return FleetRun(config, folder, task.layout)
    except PipelineError as error:
        return error


def _cohort(runs: Sequence[FleetRun]) -> list[FleetRun]:
    """Return the runs that continue now: of those neither finished nor abandoned, the ones with the fewest steps."""
    active = [run for run in runs if run.error is None and not run.is_finished]
    least = min((run.history.n_segments for run in active), default=0)
    return [run for run in active if run.history.n_segments == least]


def _segment(trainer: FleetTrainer, progress: FleetProgress) -> None:
    """Train a cohort for one segment, evaluate its actors, and write its checkpoints."""
    start, began = trainer.runs[0].n_steps, time.monotonic()
    end, returns, lengths = trainer.train_segment(progress)
    trained_s = time.monotonic() - began
    for r, run in enumerate(trainer.runs):
        run.n_steps, run.n_updates = end, trainer.n_updates
        run.tensors = trainer.tensors(r)
        try:
            if not all(bool(torch.isfinite(tensor).all()) for tensor in run.tensors.values()):
                raise diverged(run.n_steps, "its parameters are not finite")
            files, episodes = trainer.evaluate(r)
            files |= critics_file(trainer.critics(r))
            # A run's seconds are its share of the fleet's, so that the runs' sum is what was spent.
            share = trained_s / len(trainer.runs)
            row = progress_row(end, start, share, np.array(returns[r]), np.array(lengths[r]))
            run.history.segment_done(row, files, episodes.returns)
        except Exception as error:  # of this run alone, whatever its environment raises
            progress.give_up(run, error)
            continue
        run.save()
        run.tracker.segment_done(row, run.history.evaluations[-1])
    progress.segment_done(trainer.runs, start, trained_s)


def _without_the_failing(
    failed: EnvironmentFailed, task: Task, cohort: Sequence[FleetRun], progress: FleetProgress
) -> None:
    """Repeat the segment in which an environment failed with each run alone; abandon those in which it fails again."""
    if len(cohort) == 1:
        progress.give_up(cohort[0], _cause(failed))
        return
    progress.say(f"each run does this segment alone, as one run's environment fails: {message_of(_cause(failed))}")
    for run in cohort:
        try:
            with closing(FleetTrainer(task, [run])) as trainer:
                _segment(trainer, progress)
        except EnvironmentFailed as own:
            progress.give_up(run, _cause(own))


def _cause(failed: EnvironmentFailed) -> Exception:
    assert isinstance(failed.__cause__, Exception)
    return failed.__cause__
