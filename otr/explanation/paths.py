"""The tests of a tree as they come, from place to place, also where no array could hold them all."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.network import UnitForm
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree, require_tree

Place = tuple[Any, ...]


class Paths(Protocol):
    """The paths of a policy: a place is what leads to a test or, at its end, to an answer."""

    @property
    def root(self) -> Place:
        """The place where all paths begin."""

    @property
    def decides(self) -> bool:
        """Whether a leaf has a label, whatever its outputs are."""

    def test(self, place: Place) -> FloatArray | None:
        """Return the affine form [P | v] (d + 1,) of a place's test, left where it is at most 0; None at an end."""

    def child(self, place: Place, right: bool) -> Place:
        """Return the place to the right or left of a test."""

    def leaf(self, place: Place) -> int:
        """Return the number of the leaf at an end."""

    def outputs(self, place: Place) -> FloatArray:
        """Return the affine forms of the outputs at an end: (o, d + 1)."""

    def node(self, place: Place) -> int | None:
        """Return the number of a place's test node; None where a test has none."""

    def leaf_of(self, x: FloatArray) -> Any:
        """Return what leaf a state (d,) takes, to compare with others."""


@dataclass(frozen=True)
class TreePaths:
    """Those of an `ObliqueTree`: (node, ()), then (~leaf, outcomes of the head's tests where it decides the label)."""

    tree: ObliqueTree

    @property
    def root(self) -> Place:
        return (0 if self.tree.n_nodes else ~0), ()

    @property
    def decides(self) -> bool:
        return self.tree.labels is not None

    def test(self, place: Place) -> FloatArray | None:
        at, outcomes = place
        tree = self.tree
        if at >= 0:
            return np.append(tree.P[at], tree.v[at])
        if tree.labels is not None or len(outcomes) == tree.head.n_tests(tree.n_outputs):
            return None
        return _of_head(tree.head, self.outputs(place), outcomes)

    def child(self, place: Place, right: bool) -> Place:
        at, outcomes = place
        if at < 0:
            return at, (*outcomes, right)
        return int((self.tree.children_right if right else self.tree.children_left)[at]), ()

    def leaf(self, place: Place) -> int:
        return int(~place[0])

    def outputs(self, place: Place) -> FloatArray:
        return np.column_stack((self.tree.M[~place[0]], self.tree.c[~place[0]]))

    def node(self, place: Place) -> int | None:
        return None if place[0] < 0 else int(place[0])

    def leaf_of(self, x: FloatArray) -> Any:
        return int(self.tree.apply(x))


@dataclass(frozen=True)
class PatternPaths:
    """Those of a `PatternTree` with all its paths: a place is the outcomes so far; leaf i has the bits of i."""

    tree: PatternTree
    root: Place = ()

    @property
    def decides(self) -> bool:
        return self.tree.network.head.gives_labels

    @cached_property
    def _units(self) -> UnitForm:
        return self.tree.network.unit_form()

    def _forms(self, place: Place) -> FloatArray:
        network = self.tree.network
        pattern = np.zeros((1, network.n_hidden), dtype=np.bool_)
        hidden = place[: network.n_hidden]
        pattern[0, : len(hidden)] = hidden
        return np.asarray(self._units.forms(pattern, network.negative_slope)[0])

    def test(self, place: Place) -> FloatArray | None:
        network = self.tree.network
        if len(place) == self.tree.n_bits:
            return None
        forms, n = self._forms(place), network.n_hidden
        return _of_head(network.head, forms[n:], place[n:]) if len(place) >= n else np.asarray(forms[len(place)])

    def child(self, place: Place, right: bool) -> Place:
        return *place, right

    def leaf(self, place: Place) -> int:
        return int("".join("01"[bit] for bit in place) or "0", 2)

    def outputs(self, place: Place) -> FloatArray:
        return self._forms(place)[self.tree.network.n_hidden :]

    def node(self, place: Place) -> int | None:
        return None

    def leaf_of(self, x: FloatArray) -> Any:
        return self.tree.paths(x)[0].tobytes()


def _of_head(head: Head, outputs: FloatArray, outcomes: Place) -> FloatArray:
    """Return the form of the head's test that comes after some, for outputs (o, d + 1)."""
    return np.asarray(head.next_test(outputs[None], np.array([outcomes], dtype=np.bool_))[0])


def paths_of(tree: ObliqueTree | PatternTree) -> TreePaths | PatternPaths:
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
