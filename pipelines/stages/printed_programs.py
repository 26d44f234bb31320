"""The printed program beside a tree, with the environment's own names."""

from collections.abc import Callable
from pathlib import Path

import otr
from otr.programs.text import text_of_every_leaf
from pipelines.config.env import EnvConfig
from pipelines.engine.store import write_text
from pipelines.play.environments import action_names, feature_names

LARGEST_PROGRAM = 256  # leaves; a longer one is not readable, and larger than all other artefacts of a run


def write_program(tree: otr.ObliqueTree, env: EnvConfig, out: Path) -> None:
    """Write `program.txt` unless the tree has more than LARGEST_PROGRAM leaves."""
    if tree.n_leaves <= LARGEST_PROGRAM:
        write_text(out / "program.txt", program_text(tree, env))


def program_text(tree: otr.ObliqueTree, env: EnvConfig) -> str:
    """Return the tree as nested if-then-else over the environment's feature names."""
    return _text(otr.to_text, tree, env)


def program_text_of_every_leaf(tree: otr.ObliqueTree, env: EnvConfig) -> str:
    """Return the program as it was printed before equal leaves were merged, which older runs hold."""
    return _text(text_of_every_leaf, tree, env)


def _text(write: Callable[..., str], tree: otr.ObliqueTree, env: EnvConfig) -> str:
    return write(
        tree,
        feature_names=feature_names(env, tree.n_inputs),
        output_names=action_names(env, tree.head.n_answers(tree.n_outputs)),
    )
