"""The leaves of a PID policy as text: vectors of gains, as in Orfanos 2023, Fig. 4.4."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from otr.arrays import FloatArray
from otr.head import PidBox
from otr.tree import ObliqueTree

__all__ = ["control_text", "gain_lines", "term_lines"]

TERMS = ("P", "I", "D")
AffineText = Callable[[FloatArray, float], str]


def term_lines(tree: ObliqueTree, affine: AffineText) -> list[str]:
    """Return the definitions of P, I and D that hold in all leaves, ``P = [P_x, P_y]`` and so on.

    Raises:
        ValueError: the terms differ between leaves, which no PID policy does.
    """
    n_terms = _n_terms(tree)
    if (tree.M[:, :n_terms] != tree.M[0, :n_terms]).any() or (tree.c[:, :n_terms] != tree.c[0, :n_terms]).any():
        raise ValueError("the terms P, I, D differ between leaves; a PID policy's leaves differ in their gains alone")
    return [f"{term} = {vector}" for term, vector in _vectors(tree, 0, 0, affine)]


def gain_lines(tree: ObliqueTree, leaf: int, answers: Sequence[str], affine: AffineText) -> list[str]:
    """Return the lines that state a leaf's gains and its actions before the tanh.

    Args:
        tree: a tree with the head `PidBox`.
        leaf: which leaf.
        answers: names of the actions.
        affine: from coefficients (d,) and an offset to text.
    """
    lines, n_actions = [], len(answers)
    for action, name in enumerate(answers):
        suffix = f"_{name}" if n_actions > 1 else ""
        gains = _vectors(tree, leaf, (action + 1) * _n_terms(tree), affine)
        lines += [f"theta_{term}{suffix} = {vector}" for term, vector in gains]
    return lines


def control_text(answers: Sequence[str], action: int) -> str:
    """Return ``theta_P . P + theta_I . I + theta_D . D``, the action's name in it where there are several."""
    suffix = f"_{answers[action]}" if len(answers) > 1 else ""
    return " + ".join(f"theta_{term}{suffix} . {term}" for term in TERMS)


def _vectors(tree: ObliqueTree, leaf: int, first: int, affine: AffineText) -> list[tuple[str, str]]:
    """Return P, I, D each with the text of a third of the outputs from `first` on."""
    d = _n_terms(tree) // len(TERMS)
    vectors = []
    for position, term in enumerate(TERMS):
        outputs = range(first + position * d, first + (position + 1) * d)
        entries = [affine(tree.M[leaf, output], float(tree.c[leaf, output])) for output in outputs]
        vectors.append((term, f"[{', '.join(entries)}]"))
    return vectors


def _n_terms(tree: ObliqueTree) -> int:
    assert isinstance(tree.head, PidBox)
    return tree.n_outputs // (len(tree.head.low) + 1)
