"""Stage evaluate: network, tree and pruned tree on the same fixed episodes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import otr
from pipelines.config import RunConfig
from pipelines.errors import PolicyMismatchError
from pipelines.policies import answers_agree
from pipelines.rollout import Rollout, rollout
from pipelines.seeding import evaluation_seeds
from pipelines.store import load_actor, write_csv, write_json

VERSION = 1
TOLERANCE = 1e-6
EPISODE_COLUMNS = ("episode", "seed", "return", "length", "terminated", "truncated")
EPISODES_FILES = {"network": "episodes_network.csv", "tree": "episodes.csv", "pruned_tree": "episodes_pruned_tree.csv"}


def evaluate_settings(config: RunConfig) -> dict[str, Any]:
    """Return what decides the evaluation."""
    return {
        "env": {"id": config.env.id, "kwargs": config.env.kwargs},
        "n_episodes": config.evaluate.n_episodes,
        "first_seed": config.evaluate.first_seed,
    }


def load_policies(inputs: Mapping[str, Path]) -> dict[str, Any]:
    """Return the forms of the policy that a run left: network, tree and pruned tree."""
    return {
        "network": load_actor(inputs["train"]),
        "tree": otr.load(inputs["map"] / "tree"),
        "pruned_tree": otr.load(inputs["prune"] / "tree"),
    }


def evaluate(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    """Play the fixed episodes with each form of the policy; write an episodes file each and `report.json`.

    `episodes.csv` is the tree's. Fidelity is the share of the network's states in which the pruned tree acts alike.

    Raises:
        PolicyMismatchError: network and tree act differently in a state; the message shows it.
    """
    policies = load_policies(inputs)
    played = play(policies, config)
    states = played["network"].states
    network, outputs = policies["network"].predict(states), policies["network"].forward(states)
    tree = policies["tree"].predict(states)
    _require_agreement(states, network, tree, outputs)
    alike = answers_agree(network, policies["pruned_tree"].predict(states), outputs, TOLERANCE)
    for name, result in played.items():
        write_csv(out / EPISODES_FILES[name], episode_rows(result), EPISODE_COLUMNS)
    write_json(
        out / "report.json",
        {
            "fidelity": float(alike.mean()),
            "n_states": len(states),
            "policies": {n: moments(r) for n, r in played.items()},
        },
    )


def play(policies: Mapping[str, Any], config: RunConfig) -> dict[str, Rollout]:
    """Play the evaluation episodes with each policy; the network's states are kept."""
    seeds = evaluation_seeds(config.evaluate.first_seed, config.evaluate.n_episodes)
    return {
        name: rollout(policy.predict, config.env, seeds, keep_states=name == "network", n_workers=config.n_workers)
        for name, policy in policies.items()
    }


def episode_rows(played: Rollout) -> list[dict[str, Any]]:
    """Return the rows of an episodes file."""
    return [
        {
            "episode": i,
            "seed": int(played.seeds[i]),
            "return": float(played.returns[i]),
            "length": int(played.lengths[i]),
            "terminated": bool(played.terminated[i]),
            "truncated": bool(played.truncated[i]),
        }
        for i in range(len(played.seeds))
    ]


def moments(played: Rollout) -> dict[str, Any]:
    """Return mean and standard deviation of the return over episodes (the sample's, ddof 0), and their number."""
    returns = played.returns
    return {"return_mean": float(returns.mean()), "return_std": float(returns.std()), "n_episodes": len(returns)}


def _require_agreement(states: np.ndarray, network: np.ndarray, tree: np.ndarray, outputs: np.ndarray) -> None:
    agreement = answers_agree(network, tree, outputs, TOLERANCE)
    if not agreement.all():
        i = int(np.flatnonzero(~agreement)[0])
        raise PolicyMismatchError(
            f"network and tree differ in {np.count_nonzero(~agreement)} of {len(states)} states; the first is "
            f"{states[i].tolist()}: the network does {network[i].tolist()}, the tree {tree[i].tolist()}"
        )
