"""The printed program and the picture next to a tree, with the environment's own names."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import otr
from otr.programs.text import text_of_every_leaf
from pipelines.config.env import EnvConfig
from pipelines.engine.store import write_text
from pipelines.play.spaces import action_names, feature_names

LARGEST_PROGRAM = 256  # leaves; a longer one is not readable, and larger than all other artefacts of a run


def write_program(tree: otr.ObliqueTree, env: EnvConfig, out: Path) -> None:
    """Write `program.txt` unless the tree has more than LARGEST_PROGRAM leaves."""
    if tree.n_leaves <= LARGEST_PROGRAM:
        write_text(out / "program.txt", program_text(tree, env))


def write_picture(tree: otr.ObliqueTree, env: EnvConfig, states: np.ndarray, out: Path) -> None:
    """Write `tree.svg`, with the shares of the states (n, d) that end in each leaf."""
    write_text(out / "tree.svg", otr.to_svg(tree, **names_of_env(tree, env), states=states))


def and_names(settings: Callable[[Any], dict[str, Any]]) -> Callable[[Any], dict[str, Any]]:
    """Return a stage's `settings` and the names that it prints, but for those of conf/env, which do not change."""
    return lambda config: settings(config) | config.env.own_names()


def names_of_env(policy: Any, env: EnvConfig) -> dict[str, Any]:
    """Return the environment's names of a policy's inputs and answers, as programs and pictures take them."""
    return {
        "feature_names": feature_names(env, policy.n_inputs),
        "output_names": action_names(env, policy.n_answers),
    }


def program_text(tree: otr.ObliqueTree, env: EnvConfig) -> str:
    """Return the tree as nested if-then-else over the environment's feature names."""
    return _text(otr.to_text, tree, env)


def program_text_of_every_leaf(tree: otr.ObliqueTree, env: EnvConfig) -> str:
    """Return the program as it was printed before equal leaves were merged, which older runs hold."""
    return _text(text_of_every_leaf, tree, env)


def _text(write: Callable[..., str], tree: otr.ObliqueTree, env: EnvConfig) -> str:
    return write(tree, **names_of_env(tree, env))
