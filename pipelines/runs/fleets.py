"""Which runs of a sweep train together, as one fleet."""

import itertools
from collections.abc import Iterable, Sequence

from pipelines.config.run import RunConfig
from pipelines.engine.digests import digest
from pipelines.engine.stage import part_of
from pipelines.training.settings import TrainSettings, train_keys

# What runs of a fleet may differ in: a row of each stack has its own.
OWN_SETTINGS = ("learning_rate", "gamma", "weight_decay", "ent_coef", "action_noise", "action_noise_std")


def group_key(config: RunConfig) -> str:
    """Return a digest that two runs share exactly if a fleet can train them together.

    Depths make fleets of their own: mixed ones are no faster, and a run's bits stay what they are alone.
    """
    assert config.fleet is not None
    common = train_keys(part_of(config.oracle_run or config, TrainSettings))
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
