"""Stage prune: the paths that the policy reaches in its environment, OTR-hat, or the k most frequent of them."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import otr
from pipelines.config import RunConfig
from pipelines.errors import PolicyMismatchError
from pipelines.policies import answers_agree
from pipelines.programs import write_program
from pipelines.rollout import rollout
from pipelines.seeding import episode_seeds
from pipelines.store import load_actor, write_json

VERSION = 1
TOLERANCE = 1e-6


def prune_settings(config: RunConfig) -> dict[str, Any]:
    """Return what decides the pruned tree."""
    return {
        "env": {"id": config.env.id, "kwargs": config.env.kwargs},
        "n_episodes": config.prune.n_episodes,
        "k": config.prune.k,
        "seed": config.seed,
    }


def prune(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    """Play `prune.n_episodes` episodes, keep the paths they reach, and write the pruned tree and its report.

    The episodes are the run's own and not the ones it is evaluated on.

    Raises:
        PolicyMismatchError: the pruned tree differs from the network on a state that it was pruned with.
    """
    network = load_actor(inputs["train"])
    tree = otr.load(inputs["map"] / "tree")
    seeds = episode_seeds(config.seed, "prune", config.prune.n_episodes)
    states = rollout(tree.predict, config.env, seeds, keep_states=True, n_workers=config.n_workers).states
    pattern_tree = otr.PatternTree(network).observe(states)
    if config.prune.k is None:
        pruned = otr.prune_unreached(tree, states)
        agreement = answers_agree(network.predict(states), pruned.predict(states), network.forward(states), TOLERANCE)
        if not agreement.all():
            i = int(np.flatnonzero(~agreement)[0])
            raise PolicyMismatchError(
                f"the pruned tree differs from the network in a state it kept: {states[i].tolist()}"
            )
    else:
        pruned = otr.prune_to_k(tree, states, config.prune.k)
    otr.save(pruned, out / "tree")
    write_program(pruned, config.env, out)
    write_json(
        out / "report.json",
        {
            "n_leaves": pruned.n_leaves,
            "depth": pruned.depth,
            "patterns": pattern_tree.n_patterns,
            "pruned_depth": math.log2(pattern_tree.n_patterns),
            "n_episodes": config.prune.n_episodes,
            "n_states": len(states),
            "k": config.prune.k,
        },
    )
