"""The tests of a tree as they come, place by place, also where no array could hold them all."""

from __future__ import annotations

from typing import Any

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree, require_tree

Place = tuple[Any, ...]


class TreePaths:
    """A place is (node, ()) or, from a leaf on, (~leaf, outcomes of the tests of a head that decides its label)."""

    def __init__(self, tree: ObliqueTree) -> None:
        """Begin at the root."""
        self.root: Place = (0 if tree.n_nodes else ~0), ()
        self._tree, self._n_of_head = tree, tree.head.n_tests(tree.n_outputs) if tree.labels is None else 0

    def test(self, place: Place) -> FloatArray | None:
        """Return a place's test [P | v] (d + 1,), to the left where it is at most 0; None at an end."""
        at, outcomes = place
        if at >= 0:
            return np.append(self._tree.P[at], self._tree.v[at])
        return _of_head(self._tree.head, self.end(place)[1], outcomes) if len(outcomes) < self._n_of_head else None

    def child(self, place: Place, right: bool) -> Place:
        """Return the place on one side of a test."""
        at, outcomes = place
        sides = self._tree.children_right if right else self._tree.children_left
        return (int(sides[at]), ()) if at >= 0 else (at, (*outcomes, right))

    def end(self, place: Place) -> tuple[int, FloatArray]:
        """Return the number of the leaf at an end, and its affine outputs (o, d + 1)."""
        leaf = ~int(place[0])
        return leaf, np.column_stack((self._tree.M[leaf], self._tree.c[leaf]))


class PatternPaths:
    """The same of a `PatternTree` with all its paths: a place is the bits so far; leaf i has the bits of i."""

    root: Place = ()

    def __init__(self, tree: PatternTree) -> None:
        """Begin at the root."""
        self._network, self._n_bits, self._units = tree.network, tree.n_bits, tree.network.unit_form()

    def test(self, place: Place) -> FloatArray | None:
        """Return a place's test, as `TreePaths` does."""
        forms, n = self._forms(place), self._network.n_hidden
        if len(place) < n:
            return np.asarray(forms[len(place)])
        return _of_head(self._network.head, forms[n:], place[n:]) if len(place) < self._n_bits else None

    def child(self, place: Place, right: bool) -> Place:
        """Return the place on one side of a test."""
        return *place, right

    def end(self, place: Place) -> tuple[int, FloatArray]:
        """Return the number of the leaf at an end, and its affine outputs (o, d + 1)."""
        return int("".join("01"[bit] for bit in place) or "0", 2), self._forms(place)[self._network.n_hidden :]

    def _forms(self, place: Place) -> FloatArray:
        pattern = np.zeros((1, self._network.n_hidden), dtype=np.bool_)
        pattern[0, : len(place)] = place[: self._network.n_hidden]
        return np.asarray(self._units.forms(pattern, self._network.negative_slope)[0])


Paths = TreePaths | PatternPaths


def _of_head(head: Head, outputs: FloatArray, outcomes: Place) -> FloatArray:
    return np.asarray(head.next_test(outputs[None], np.array([outcomes], dtype=np.bool_))[0])


def paths_of(tree: ObliqueTree | PatternTree) -> Paths:
    """Return the paths of a tree; raise TypeError for what is none."""
    if isinstance(tree, PatternTree):
        return TreePaths(tree.to_tree()) if tree.is_restricted else PatternPaths(tree)
    require_tree(tree)
    return TreePaths(tree)


def path_of(paths: Paths, x: FloatArray) -> list[Place]:
    """Return the places that a state (d,) comes to, the end last."""
    places, state = [paths.root], np.append(x, 1.0)
    while (form := paths.test(places[-1])) is not None:
        places.append(paths.child(places[-1], bool(form @ state > 0)))
    return places
