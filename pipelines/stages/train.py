"""Stage train: the actor, the best of its evaluations, by Stable-Baselines3, in a fleet, or by direct search."""

import itertools
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipelines.config.algo import ArsConfig
from pipelines.config.run import RunConfig
from pipelines.engine.console import duration
from pipelines.engine.digests import digest
from pipelines.engine.stage import Stage
from pipelines.errors import PipelineError
from pipelines.training.checkpoints import evaluations_so_far
from pipelines.training.estimates import estimated_bytes, estimated_seconds

VERSION = 1
FLEET_VERSION = 1  # of the fleet trainer alone; part of its runs' settings
LONG_RUN_S = 60.0
# What runs of a fleet may differ in: a row of each stack has its own.
OWN_SETTINGS = ("learning_rate", "critic_learning_rate", "gamma", "weight_decay", "ent_coef", "action_noise",
                "action_noise_std")  # fmt: skip


def train_settings(config: RunConfig) -> dict[str, Any]:
    """Return what decides the trained actor; programs' names and later stages' settings do not."""
    everything = config.settings()
    env = config.env.settings()
    kept = {key: everything[key] for key in ("algo", "actor", "train", "seed")}
    if config.method.decides_training:
        kept["method"] = everything["method"]
    if config.fleet:
        # These two were settings; committed runs, whose keys have them, all have these values.
        former = {"environments": "gymnasium", "precision": "fp32"}
        kept["trainer"] = {**everything["trainer"], **former, "version": FLEET_VERSION}
    return {"env": env, "hidden_widths": everything["depth"], **kept}


def train(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    """Train, and write the best actor, `evaluations.csv` and `progress.csv` into `out`; raises as `train_by_sb3`.

    Where Ctrl-C stops it, the checkpoint of the last whole segment stays.
    """
    if config.fleet:
        (error,) = train_together([inputs], [config], [out])
        if error is not None:
            raise error
    elif isinstance(config.algo, ArsConfig):
        from pipelines.training.search.train import train_by_search  # imports gymnasium

        train_by_search(config, checkpoint_folder(config), out)
    else:
        from pipelines.training.sb3_training import train_by_sb3  # imports torch

        train_by_sb3(config, checkpoint_folder(config), out)


def train_together(
    inputs: Sequence[Mapping[str, Path]], configs: Sequence[RunConfig], outs: Sequence[Path]
) -> list[Exception | None]:
    """Do `train` for the runs of a fleet as one; return what each failed with."""
    from pipelines.training.fleet.train import train_fleet  # imports torch

    return train_fleet(configs, [checkpoint_folder(config) for config in configs], outs)


def checkpoint_folder(config: RunConfig, inputs: Mapping[str, Path] | None = None) -> Path:
    """Return where the run's checkpoints lie while it trains; training reads no other stage.

    Runs that lie side by side and train alike share them, as they share the result.
    """
    place = str(Path(config.folder).parent)
    return Path(config.results_dir) / "checkpoints" / digest([VERSION, place, train_settings(config)])[:16]


def trained_steps(config: RunConfig) -> int:
    """Return how many environment steps the run's checkpoint holds; 0 where there is none."""
    return evaluations_so_far(checkpoint_folder(config))[1]


def seconds_left(config: RunConfig) -> float:
    """Return the likely time of what is left to train, in seconds on one core."""
    return estimated_seconds(config, trained_steps(config))


def announce_training(configs: Sequence[RunConfig]) -> None:
    """Print the likely time and disk of a long training, of one run or a fleet; refuse what cannot fit on the disk."""
    config, done = configs[0], list(map(_readable_steps, configs))
    left = [max(0, each.train.steps - n) for each, n in zip(configs, done, strict=True)]
    seconds = sum(map(estimated_seconds, configs, done))
    n_bytes = sum(map(_bytes_left, configs, left))
    folder = Path(config.results_dir)
    free = shutil.disk_usage(folder).free
    if n_bytes > free:
        raise PipelineError(
            f"{folder}: training needs about {n_bytes / 1e6:,.0f} MB for checkpoints, {free / 1e6:,.0f} MB are free\n"
            "Choose another place with results_dir=PATH, or a smaller algo.buffer_size."
        )
    if seconds >= LONG_RUN_S:
        runs = f"{len(configs)} runs as one, " if len(configs) > 1 else ""
        print(
            f"train: {runs}{sum(left):,} steps of {config.algo.name.upper()}, some {duration(seconds)} on one core "
            f"(measured as it goes), up to {max(1, round(n_bytes / 1e6))} MB of checkpoints; Ctrl-C stops, the same "
            "command goes on",
            flush=True,
        )


def _readable_steps(config: RunConfig) -> int:
    """Return the steps that a run's checkpoint holds; of a damaged one 0, as its training says so and is not begun."""
    try:
        return trained_steps(config)
    except PipelineError:
        return 0


def _bytes_left(config: RunConfig, n_steps: int) -> int:
    """Return the likely size of the checkpoints of the steps that are left; a fleet's is reserved when it starts."""
    is_reserved = config.fleet is not None and n_steps < config.train.steps
    return 0 if is_reserved else estimated_bytes(config) * n_steps // config.train.steps


def group_key(config: RunConfig) -> str:
    """Return a digest that two runs share exactly if a fleet can train them together.

    Depths make fleets of their own: mixed ones are no faster, and a run's bits stay what they are alone.
    """
    assert config.fleet is not None
    common = train_settings(config.oracle_run or config)
    del common["seed"]
    common["algo"] = {key: value for key, value in common["algo"].items() if key not in OWN_SETTINGS}
    return digest([common, config.results_dir])


def fleets(configs: Iterable[RunConfig]) -> list[list[int]]:
    """Return the positions of the runs that train together, in order of their first run.

    A run that no fleet trains is alone. A group larger than `runs_per_process` is cut into parts of nearly equal size.
    """
    groups: dict[str, list[int]] = {}
    sizes: dict[str, int] = {}
    for i, config in enumerate(configs):
        key = group_key(config) if config.fleet else f"alone {i}"
        groups.setdefault(key, []).append(i)
        sizes[key] = config.fleet.runs_per_process if config.fleet else 1
    parts = [part for key, group in groups.items() for part in _parts(group, sizes[key])]
    return sorted(parts, key=lambda part: part[0])


def _parts(group: Sequence[int], most: int) -> list[list[int]]:
    n_parts = -(-len(group) // most)
    bounds = [len(group) * part // n_parts for part in range(n_parts + 1)]
    return [list(group[start:end]) for start, end in itertools.pairwise(bounds)]


TRAIN = Stage("train", VERSION, inputs=(), settings=train_settings, run=train, checkpoints=checkpoint_folder)
