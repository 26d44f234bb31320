"""The stages, one row each: version, inputs, the settings that key it, the function that does it."""

from collections.abc import Mapping
from pathlib import Path

from pipelines.config import RunConfig
from pipelines.config.methods import EXTRA_STAGES, METHODS
from pipelines.engine.stage import Stage
from pipelines.stages.certify import VERSION as CERTIFY_VERSION
from pipelines.stages.certify import certify, certify_settings
from pipelines.stages.evaluate import VERSION as EVALUATE_VERSION
from pipelines.stages.evaluate import evaluate, evaluate_settings
from pipelines.stages.imitation import IMITATE_VERSION, imitate_settings
from pipelines.stages.map import VERSION as MAP_VERSION
from pipelines.stages.map import map_actor, map_settings
from pipelines.stages.oracle import VERSION as ORACLE_VERSION
from pipelines.stages.oracle import oracle_settings, refer
from pipelines.stages.parse import VERSION as PARSE_VERSION
from pipelines.stages.parse import parse, parse_settings
from pipelines.stages.prune import VERSION as PRUNE_VERSION
from pipelines.stages.prune import prune, prune_settings
from pipelines.stages.simplify import VERSION as SIMPLIFY_VERSION
from pipelines.stages.simplify import simplify, simplify_settings
from pipelines.training.estimates import (
    HARDEN_VERSION,
    TRAIN_VERSION,
    checkpoint_folder,
    harden_settings,
    train_settings,
)


def _train(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    # torch and Stable-Baselines3 take seconds to import; the other stages need neither.
    if config.fleet:
        from pipelines.training.fleet.train import train_fleet

        (error,) = train_fleet([config], [checkpoint_folder(config)], [out])
        if error is not None:
            raise error
    else:
        from pipelines.stages.train import train

        train(inputs, config, out)


def _imitate(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    from pipelines.stages.imitate import imitate  # imports scikit-learn

    imitate(inputs, config, out)


def _harden(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    from pipelines.stages.harden import harden_actor  # imports torch

    harden_actor(inputs, config, out)


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage("train", TRAIN_VERSION, (), train_settings, _train),
        Stage("oracle", ORACLE_VERSION, (), oracle_settings, refer),
        Stage("map", MAP_VERSION, ("train",), map_settings, map_actor),
        Stage("harden", HARDEN_VERSION, ("train",), harden_settings, _harden),
        Stage("imitate", IMITATE_VERSION, ("oracle",), imitate_settings, _imitate),
        Stage("certify", CERTIFY_VERSION, ("train", "map"), certify_settings, certify),
        Stage("simplify", SIMPLIFY_VERSION, ("prune",), simplify_settings, simplify),
        Stage("parse", PARSE_VERSION, (), parse_settings, parse),
    )
}


def stages_of(method: str) -> dict[str, Stage]:
    """Return a method's stages and the extras by name, in order; prune and evaluate read what its tree comes from."""
    stages = METHODS[method].stages
    inputs = stages[: stages.index("prune")]
    read = {
        "prune": Stage("prune", PRUNE_VERSION, inputs, prune_settings, prune),
        "evaluate": Stage("evaluate", EVALUATE_VERSION, (*inputs, "prune"), evaluate_settings, evaluate),
    }
    return {name: read[name] if name in read else STAGES[name] for name in (*stages, *EXTRA_STAGES)}
