"""Stage harden: the tree that a trained soft tree or experts become, which is the policy from here on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import otr
from pipelines.config.algo import AlgoConfig, SacConfig
from pipelines.config.env import EnvConfig
from pipelines.config.method import MethodConfig
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_json
from pipelines.play.environments import make_env
from pipelines.play.printed_programs import write_program


@dataclass(frozen=True)
class HardenSettings:
    """What the stage reads of a run's configuration."""

    env: EnvConfig
    algo: AlgoConfig
    method: MethodConfig


def harden_actor(inputs: Inputs, settings: HardenSettings, out: Path) -> None:
    """Write the hard tree, its program and `report.json`.

    Of SDT and CDT the authors' own discretisation too, `discretised.npz`: each test keeps its largest weight alone.
    """
    from pipelines.training.soft_trees import harden, load_soft  # imports torch

    module = load_soft(inputs["train"])
    env = make_env(settings.env)
    env.close()
    is_squashed = isinstance(settings.algo, SacConfig)
    tree = harden(module, env.action_space, is_squashed=is_squashed)
    report: dict[str, Any] = {"n_leaves": tree.n_leaves, "depth": tree.depth}
    otr.save(tree, out / "tree")
    write_program(tree, settings.env, out)
    if "discretised" in settings.method.forms:
        discretised = harden(module, env.action_space, is_squashed=is_squashed, axis_aligned=True)
        otr.save(discretised, out / "discretised")
    write_json(out / "report.json", report)


HARDEN_KEYS = picked(env="env.id", feature_names="env.feature_names", action_names="env.action_names")
HARDEN = Stage("harden", version=1, inputs=("train",), keyed=HARDEN_KEYS, run=harden_actor, settings=HardenSettings)
