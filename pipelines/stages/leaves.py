"""Stage leaves: the return against the number of leaves kept, OTR-hat(k) for k = 1, 2, 4, ... and all reached."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_csv, write_json
from pipelines.play.episodes import PlaysEvaluation, PlaysPruning, moments, play_evaluation, play_pruning
from pipelines.stages.prune import load_tree

COLUMNS = ("n_leaves", "share_of_states", "return_mean", "return_std", "n_episodes")


@dataclass(frozen=True)
class LeavesSettings(PlaysPruning, PlaysEvaluation):
    """What the stage reads of a run's configuration."""


def leaves(inputs: Inputs, settings: LeavesSettings, out: Path) -> None:
    """Play the evaluation episodes with each OTR-hat(k) of the pruned tree, or the polished one; write `returns.csv`.

    The k leaves are those that the tree visits most often in the episodes that it was pruned with, so that no
    episode decides on what it is judged by. `share_of_states` is the share of their states in these leaves.
    """
    tree = load_tree(inputs.get("polish") or inputs["prune"])
    states = play_pruning(tree.predict, settings).states
    visits = np.sort(np.bincount(tree.apply(states), minlength=tree.n_leaves))[::-1]
    n_reached = int(np.count_nonzero(visits))
    rows: list[dict[str, Any]] = []
    for k in numbers_of_leaves(n_reached):
        kept = otr.prune_to_k(tree, states, k)
        played = play_evaluation(kept.predict, settings)
        share = float(visits[:k].sum() / len(states))
        row = {"n_leaves": k, "share_of_states": share, **moments(played), "n_episodes": len(played.seeds)}
        rows.append(row)
        print(f"leaves: {k:,} of {n_reached:,} kept, return {row['return_mean']:.1f}", flush=True)
    write_csv(out / "returns.csv", rows, COLUMNS)
    polished = {"policy": "polished"} if "polish" in inputs else {}
    write_json(out / "report.json", {"n_reached": n_reached, "n_states": len(states)} | polished)


def numbers_of_leaves(n_reached: int) -> list[int]:
    """Return 1, 2, 4, ... below the number of leaves that are reached, and that number."""
    return [*(2**i for i in range((n_reached - 1).bit_length())), n_reached]


LEAVES_KEYS = picked(
    env="env", seed="seed", n_prune_episodes="prune.n_episodes", n_episodes="evaluate.n_episodes",
    first_seed="evaluate.first_seed"
)  # fmt: skip
LEAVES = Stage("leaves", version=1, inputs=("prune",), keyed=LEAVES_KEYS, run=leaves, settings=LeavesSettings)
