"""Stage train: the actor, the best of its evaluations, by Stable-Baselines3, in a fleet, or by direct search."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from pipelines.config.algo import ArsConfig
from pipelines.engine.console import duration
from pipelines.engine.digests import digest
from pipelines.engine.stage import Inputs, Stage
from pipelines.errors import PipelineError
from pipelines.training.checkpoints import evaluations_so_far
from pipelines.training.estimates import estimated_bytes, estimated_seconds
from pipelines.training.settings import TrainSettings, train_keys

VERSION = 1
LONG_RUN_S = 60.0


def train(inputs: Inputs, settings: TrainSettings, out: Path) -> None:
    """Train, and write the best actor, `evaluations.csv` and `progress.csv` into `out`; raises as `train_by_sb3`.

    Where Ctrl-C stops it, the checkpoint of the last whole segment stays.
    """
    if settings.fleet:
        (error,) = train_together([inputs], [settings], [out])
        if error is not None:
            raise error
    elif isinstance(settings.algo, ArsConfig):
        from pipelines.training.search.train_by_search import train_by_search  # imports gymnasium

        train_by_search(settings, checkpoint_folder(settings), out)
    else:
        from pipelines.training.sb3.training import train_by_sb3  # imports torch

        train_by_sb3(settings, checkpoint_folder(settings), out)


def train_together(
    inputs: Sequence[Inputs], runs: Sequence[TrainSettings], outs: Sequence[Path]
) -> list[Exception | None]:
    """Do `train` for the runs of a fleet as one; return what each failed with."""
    from pipelines.training.fleet.train_fleet import train_fleet  # imports torch

    return train_fleet(runs, [checkpoint_folder(settings) for settings in runs], outs)


def checkpoint_folder(settings: TrainSettings, inputs: Inputs | None = None) -> Path:
    """Return where the run's checkpoints are while it trains; training reads no other stage.

    Runs in the same results folder that train alike share them, as they share the result.
    """
    place = str(Path(settings.folder).parent)
    return Path(settings.results_dir) / "checkpoints" / digest([VERSION, place, train_keys(settings)])[:16]


def trained_steps(settings: TrainSettings) -> int:
    """Return how many environment steps the run's checkpoint holds; 0 where there is none."""
    return evaluations_so_far(checkpoint_folder(settings))[1]


def seconds_left(settings: TrainSettings) -> float:
    """Return the likely time of what is left to train, in seconds on one core."""
    return estimated_seconds(settings, trained_steps(settings))


def announce_training(runs: Sequence[TrainSettings]) -> None:
    """Print the likely time and disk of a long training, of one run or a fleet; refuse what cannot fit on the disk."""
    first, done = runs[0], list(map(_readable_steps, runs))
    left = [max(0, each.train.steps - n) for each, n in zip(runs, done, strict=True)]
    seconds = sum(map(estimated_seconds, runs, done))
    n_bytes = sum(map(_bytes_left, runs, left))
    folder = Path(first.results_dir)
    free = shutil.disk_usage(folder).free
    if n_bytes > free:
        raise PipelineError(
            f"{folder}: training needs about {n_bytes / 1e6:,.0f} MB for checkpoints, {free / 1e6:,.0f} MB are free\n"
            "Choose another place with results_dir=PATH, or a smaller algo.buffer_size."
        )
    if seconds >= LONG_RUN_S:
        together = f"{len(runs)} runs as one, " if len(runs) > 1 else ""
        print(
            f"train: {together}{sum(left):,} steps of {first.algo.name.upper()}, some {duration(seconds)} on one core "
            f"(measured as it goes), up to {max(1, round(n_bytes / 1e6))} MB of checkpoints; Ctrl-C stops, the same "
            "command goes on",
            flush=True,
        )


def _readable_steps(settings: TrainSettings) -> int:
    """Return the steps that a run's checkpoint holds; of a damaged one 0, which its training then reports."""
    try:
        return trained_steps(settings)
    except PipelineError:
        return 0


def _bytes_left(settings: TrainSettings, n_steps: int) -> int:
    """Return the likely size of the checkpoints of the steps that are left; a fleet's is reserved when it starts."""
    is_reserved = settings.fleet is not None and n_steps < settings.train.steps
    return 0 if is_reserved else estimated_bytes(settings) * n_steps // settings.train.steps


TRAIN = Stage(
    "train", VERSION, inputs=(), keyed=train_keys, run=train, settings=TrainSettings, announce=announce_training,
    seconds_left=seconds_left, together=train_together, checkpoints=checkpoint_folder,
)  # fmt: skip
