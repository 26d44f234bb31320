"""PID policies in programs: their outputs are terms, then gains (Orfanos 2023, Fig. 4.4); an action joins them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import PidBox
from otr.core.tree import ObliqueTree

__all__ = ["control_text", "gain_lines", "gain_vectors", "joined", "pid_output_names", "term_lines", "term_vectors"]

TERMS = ("P", "I", "D")
AffineText = Callable[[FloatArray, float], str]


def pid_output_names(tree: ObliqueTree, answers: Sequence[str]) -> list[str]:
    """Return a name for every output of a PID policy: P0, ..., I0, ..., D0, ..., theta_P0, ... action by action."""
    d = _n_terms(tree) // len(TERMS)
    terms = [f"{term}{i}" for term in TERMS for i in range(d)]
    suffixes = [f"_{answer}" if len(answers) > 1 else "" for answer in answers]
    return [*terms, *(f"theta_{term}{suffix}" for suffix in suffixes for term in terms)]


def joined(outputs: Sequence[str], n_actions: int) -> list[str]:
    """Return what each action is before the tanh, from the outputs' names: ``theta_P0 * P0 + theta_P1 * P1 + ...``."""
    n_terms = len(outputs) // (n_actions + 1)
    gains = [outputs[(action + 1) * n_terms : (action + 2) * n_terms] for action in range(n_actions)]
    return [" + ".join(f"{gain} * {term}" for gain, term in zip(own, outputs, strict=False)) for own in gains]


def term_lines(tree: ObliqueTree, affine: AffineText) -> list[str]:
    """Return the definitions of P, I and D that hold in all leaves, ``P = [P_x, P_y]`` and so on.

    Raises:
        ValueError: the terms differ between leaves, which no PID policy does.
    """
    return [f"{term} = [{', '.join(entries)}]" for term, entries in term_vectors(tree, affine)]


def term_vectors(tree: ObliqueTree, affine: AffineText) -> list[tuple[str, list[str]]]:
    """Return P, I and D, each with the texts of its components, which hold in all leaves.

    Raises:
        ValueError: the terms differ between leaves, which no PID policy does.
    """
    n_terms = _n_terms(tree)
    if (tree.M[:, :n_terms] != tree.M[0, :n_terms]).any() or (tree.c[:, :n_terms] != tree.c[0, :n_terms]).any():
        raise ValueError("the terms P, I, D differ between leaves; a PID policy's leaves differ in their gains alone")
    return _vectors(tree, 0, 0, affine)


def gain_vectors(tree: ObliqueTree, leaf: int, action: int, affine: AffineText) -> list[tuple[str, list[str]]]:
    """Return P, I and D, each with the texts of a leaf's gains for it, for one action."""
    return _vectors(tree, leaf, (action + 1) * _n_terms(tree), affine)


def gain_lines(tree: ObliqueTree, leaf: int, answers: Sequence[str], affine: AffineText) -> list[str]:
    """Return the lines that state a leaf's gains; a vector with a gain that varies takes a line for each of its gains.

    Args:
        tree: a tree with the head `PidBox`.
        leaf: which leaf.
        answers: names of the actions.
        affine: from coefficients (d,) and an offset to text.
    """
    lines, n_actions = [], len(answers)
    for action, answer in enumerate(answers):
        suffix = f"_{answer}" if n_actions > 1 else ""
        first = (action + 1) * _n_terms(tree)
        by_term = tree.M[leaf, first : first + _n_terms(tree)].reshape(len(TERMS), -1)
        varies = np.count_nonzero(by_term, axis=1).tolist()
        for (term, entries), one_a_line in zip(gain_vectors(tree, leaf, action, affine), varies, strict=True):
            name = f"theta_{term}{suffix}"
            if one_a_line:
                lines += [f"{name} = [", *(f"    {entry}," for entry in entries), "]"]
            else:
                lines.append(f"{name} = [{', '.join(entries)}]")
    return lines


def control_text(answers: Sequence[str], action: int) -> str:
    """Return ``theta_P . P + theta_I . I + theta_D . D``, the action's name in it where there are several."""
    suffix = f"_{answers[action]}" if len(answers) > 1 else ""
    return " + ".join(f"theta_{term}{suffix} . {term}" for term in TERMS)


def _vectors(tree: ObliqueTree, leaf: int, first: int, affine: AffineText) -> list[tuple[str, list[str]]]:
    """Return P, I, D each with the texts of a third of the outputs from `first` on."""
    d = _n_terms(tree) // len(TERMS)
    vectors = []
    for position, term in enumerate(TERMS):
        outputs = range(first + position * d, first + (position + 1) * d)
        vectors.append((term, [affine(tree.M[leaf, output], float(tree.c[leaf, output])) for output in outputs]))
    return vectors


def _n_terms(tree: ObliqueTree) -> int:
    assert isinstance(tree.head, PidBox)
    return tree.n_outputs // (len(tree.head.low) + 1)
