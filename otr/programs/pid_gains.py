"""PID policies in programs: their outputs are terms, then gains (Orfanos 2023, Fig. 4.4); an action joins them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.heads import PidBox
from otr.core.tree import ObliqueTree

TERMS = PidBox.terms
AffineText = Callable[[FloatArray, float], str]


def joined(outputs: Sequence[str], n_actions: int) -> list[str]:
    """Return what each action is before the tanh, from the outputs' names: ``theta_P0 * P0 + theta_P1 * P1 + ...``."""
    n_terms = len(outputs) // (n_actions + 1)
    gains = [outputs[(action + 1) * n_terms : (action + 2) * n_terms] for action in range(n_actions)]
    return [" + ".join(f"{gain} * {term}" for gain, term in zip(own, outputs, strict=False)) for own in gains]


def term_vectors(tree: ObliqueTree, affine: AffineText) -> list[tuple[str, list[str]]]:
    """Return P, I and D with the texts of their components; raise ValueError if these differ between leaves."""
    n_terms = _n_terms(tree)
    if (tree.M[:, :n_terms] != tree.M[0, :n_terms]).any() or (tree.c[:, :n_terms] != tree.c[0, :n_terms]).any():
        raise ValueError("the terms P, I, D differ between leaves; a PID policy's leaves differ in their gains alone")
    return _vectors(tree, 0, 0, affine)


def gain_vectors(tree: ObliqueTree, leaf: int, action: int, affine: AffineText) -> list[tuple[str, list[str], bool]]:
    """Return P, I and D with the texts of a leaf's gains for one action, and whether one of these varies."""
    first, n = (action + 1) * _n_terms(tree), _n_terms(tree)
    varies = np.any(tree.M[leaf, first : first + n].reshape(len(TERMS), -1), axis=1)
    vectors = _vectors(tree, leaf, first, affine)
    return [(term, gains, bool(each)) for (term, gains), each in zip(vectors, varies, strict=True)]


def _vectors(tree: ObliqueTree, leaf: int, first: int, affine: AffineText) -> list[tuple[str, list[str]]]:
    """Return P, I, D each with the texts of a third of the outputs from `first` on."""
    d = _n_terms(tree) // len(TERMS)
    vectors = []
    for position, term in enumerate(TERMS):
        outputs = range(first + position * d, first + (position + 1) * d)
        vectors.append((term, [affine(tree.M[leaf, output], float(tree.c[leaf, output])) for output in outputs]))
    return vectors


def _n_terms(tree: ObliqueTree) -> int:
    return tree.n_outputs // (tree.head.n_answers(tree.n_outputs) + 1)
