"""The stages, one row each: version, inputs, the settings that key it, the function that does it."""

from collections.abc import Mapping
from pathlib import Path

from pipelines.config import RunConfig
from pipelines.evaluate import VERSION as EVALUATE_VERSION
from pipelines.evaluate import evaluate, evaluate_settings
from pipelines.map import VERSION as MAP_VERSION
from pipelines.map import map_actor, map_settings
from pipelines.prune import VERSION as PRUNE_VERSION
from pipelines.prune import prune, prune_settings
from pipelines.stage import Stage
from pipelines.training import TRAIN_VERSION, train_settings


def _train(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    # torch and Stable-Baselines3 take seconds to import; the other stages need neither.
    if config.fleet:
        from pipelines.fleet.train import train
    else:
        from pipelines.train import train
    train(inputs, config, out)


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage("train", TRAIN_VERSION, (), train_settings, _train),
        Stage("map", MAP_VERSION, ("train",), map_settings, map_actor),
        Stage("prune", PRUNE_VERSION, ("train", "map"), prune_settings, prune),
        Stage("evaluate", EVALUATE_VERSION, ("train", "map", "prune"), evaluate_settings, evaluate),
    )
}
