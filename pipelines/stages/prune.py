"""Stage prune: the paths that the policy reaches in its environment, OTR-hat, or the k most frequent of them."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr
from otr.control import constant_gains
from pipelines.config.method import MethodConfig
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_json, write_text
from pipelines.errors import PolicyMismatchError
from pipelines.play.actor_files import load_actor
from pipelines.play.agreement import answers_agree
from pipelines.play.episodes import PlaysPruning, play_pruning
from pipelines.play.printed_programs import and_names, program_text, write_picture, write_program


@dataclass(frozen=True)
class PruneSettings(PlaysPruning):
    """What the stage reads of a run's configuration."""

    method: MethodConfig


def prune(inputs: Inputs, settings: PruneSettings, out: Path) -> None:
    """Play `prune.n_episodes` episodes, keep the paths they reach, and write the pruned tree and its report.

    The episodes are the run's own and not the ones it is evaluated on. A path is an activation pattern where the tree
    is a mapped network's, and a leaf of the tree where it is not. Of a PID policy also `constant_gains`, the pruned
    tree with each leaf's gains averaged over the states of these episodes in it. Of a tree that is held as
    activation patterns also `paths`, those that are kept and how often they were taken: archives hold them for the
    pruned tree, which is a hundred times as large.

    Raises:
        PolicyMismatchError: the pruned tree differs from the policy on a state that it was pruned with.
    """
    policy: Any
    tree: Any = otr.load(inputs[settings.method.tree_stage] / "tree")
    states = play_pruning(tree.predict, settings).states
    if "map" in inputs:
        network = load_actor(inputs[settings.method.actor_stage])
        policy, patterns = network, otr.PatternTree(network).observe(states).n_patterns
    else:
        policy, patterns = tree, len(np.unique(tree.apply(states)))
    if settings.prune.k is None:
        pruned = otr.prune_unreached(tree, states)
        agreement = answers_agree(policy.predict(states), pruned.predict(states), policy.forward(states))
        if not agreement.all():
            i = int(np.flatnonzero(~agreement)[0])
            raise PolicyMismatchError(
                f"the pruned tree differs from the policy in a state it kept: {states[i].tolist()}"
            )
    else:
        pruned = otr.prune_to_k(tree, states, settings.prune.k)
    otr.save(pruned, out / "tree")
    if isinstance(tree, otr.PatternTree):
        taken = otr.PatternTree(tree.network).observe(states)
        otr.save(taken.observed() if settings.prune.k is None else taken.keep(settings.prune.k), out / "paths")
    write_program(pruned, settings.env, out)
    write_picture(pruned, settings.env, states, out)
    if not pruned.head.acts_by_output:  # gains in the leaves
        constant = constant_gains(pruned, states)
        otr.save(constant, out / "constant_gains")
        write_text(out / "constant_gains.txt", program_text(constant, settings.env))
    write_json(
        out / "report.json",
        {
            "n_leaves": pruned.n_leaves,
            "depth": pruned.depth,
            "patterns": patterns,
            "pruned_depth": math.log2(patterns),
            "n_episodes": settings.prune.n_episodes,
            "n_states": len(states),
            "k": settings.prune.k,
        },
    )


def load_tree(folder: Path) -> otr.ObliqueTree:
    """Return a stage's pruned tree; of a PID policy the one with constant gains, whose leaves are affine."""
    name = "constant_gains" if (folder / "constant_gains.json").is_file() else "tree"
    tree = otr.load(folder / name)
    if not isinstance(tree, otr.ObliqueTree):  # pruned trees are explicit
        raise TypeError(f"{folder} holds a {type(tree).__name__}, expected an ObliqueTree")
    return tree


# Its inputs depend on the method: `pipelines.runs.stage_table.stages_of` sets them.
PRUNE_KEYS = and_names(picked(env="env", n_episodes="prune.n_episodes", k="prune.k", seed="seed"))
PRUNE = Stage("prune", version=1, inputs=(), keyed=PRUNE_KEYS, run=prune, settings=PruneSettings)
