"""Paths through a program, each a place in a tree that grows by a test wherever one of them divides."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from otr.core.arrays import FloatArray, IntArray
from otr.errors import TreeTooLargeError
from otr.programs.language.tokens import Place
from otr.programs.language.values import Affine, Value

Slot = tuple[int, int]  # a test node and its side, 0 is left; node -1 is above the root
Key = tuple[object, ...]  # of a test: equal for equal functions


@dataclass(slots=True)
class Path:
    """One way through the program."""

    slot: Slot  # where in the tree the path goes on
    at: Place  # the statement under way
    values: dict[str, Value] = field(default_factory=dict)  # of the program's names; `assign` changes it
    is_shared: bool = False  # whether another path may hold the same dict of values

    def fork(self, slot: Slot) -> Path:
        """Return the path that goes on at `slot` after a test."""
        return Path(slot, self.at, self.values, is_shared=True)

    def assign(self, name: str, value: Value) -> None:
        """Give a name a value on this path alone."""
        if self.is_shared:
            self.values, self.is_shared = dict(self.values), False
        self.values[name] = value


class GrowingTree:
    """The tests made so far. A child is made after its parent, so its index is higher.

    What a path has decided is read from the tree, so that it takes no memory: the nodes above the path. A node's jump
    leads to one far above it, so that every one of n nodes above is reached in O(log n) steps (Myers 1983, "An
    applicative random-access stack").
    """

    def __init__(self, n_inputs: int, max_leaves: int) -> None:
        self._n_inputs, self._max_leaves = n_inputs, max_leaves
        self._tests: list[Affine] = []
        self._children: list[list[int]] = [[], []]
        self._keys: list[Key] = []
        self._nodes_of: dict[Key, list[int]] = {}
        self._above: list[Slot] = []
        self._jump: list[int] = []
        self._depth: list[int] = []

    def divide(self, path: Path, form: Affine) -> tuple[Path | None, Path | None]:
        """Return how `path` goes on where ``form <= 0`` and where not; None where no input can get.

        No test is made for a constant, nor for one that the path has decided, or whose negative it has. Raise
        TreeTooLargeError beyond `max_leaves` leaves.
        """
        key = form.key
        outcome = form.offset <= 0 if form.is_constant else self._decided(path.slot, key)
        if outcome is None and self._decided(path.slot, form.times(-1.0).key) is False:  # -form > 0
            outcome = True
        if outcome is not None:
            return (path, None) if outcome else (None, path)
        if len(self._tests) + 2 > self._max_leaves:
            raise TreeTooLargeError(
                f"line {path.at.line}: the program has more than {self._max_leaves} leaves, because every test here is "
                "made on each of the paths that come before it; write it with fewer of them, or raise max_leaves"
            )
        node = self._new_node(path.slot, form, key)
        return path.fork((node, 0)), path.fork((node, 1))

    def _new_node(self, slot: Slot, form: Affine, key: Key) -> int:
        node, (above, _) = len(self._tests), slot
        self._put(slot, node)
        self._tests.append(form)
        self._keys.append(key)
        self._nodes_of.setdefault(key, []).append(node)
        for side in self._children:
            side.append(0)
        self._above.append(slot)
        if above < 0:
            self._depth.append(0)
            self._jump.append(node)
        else:
            jump = self._jump[above]
            is_even = self._depth[above] - self._depth[jump] == self._depth[jump] - self._depth[self._jump[jump]]
            self._depth.append(self._depth[above] + 1)
            self._jump.append(self._jump[jump] if is_even else above)
        return node

    def _decided(self, slot: Slot, key: Key) -> bool | None:
        """Return whether the path to `slot` went left at a test, or None if it has not made it."""
        nodes, (last, _) = self._nodes_of.get(key, ()), slot
        if last >= 0 and len(nodes) > self._depth[last]:  # fewer nodes are above than make this test
            while slot[0] >= 0 and self._keys[slot[0]] != key:
                slot = self._above[slot[0]]
            return slot[1] == 0 if slot[0] >= 0 else None
        sides = (self._side(node, slot) for node in nodes)
        return next((side == 0 for side in sides if side is not None), None)

    def _side(self, node: int, slot: Slot) -> int | None:
        """Return the side of `node` that a slot is below, or None if it is not below that node."""
        depth = self._depth[node]
        while slot[0] >= 0 and self._depth[slot[0]] > depth:
            jump = self._jump[slot[0]]
            slot = (jump, -1) if self._depth[jump] > depth else self._above[slot[0]]
        return slot[1] if slot[0] == node else None

    def end(self, path: Path, leaf: int) -> None:
        """Let a path end in a leaf."""
        self._put(path.slot, ~leaf)

    def arrays(self) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Return children_left, children_right, P and v of `ObliqueTree`."""
        P, v = np.zeros((len(self._tests), self._n_inputs)), np.array([test.offset for test in self._tests])
        for row, test in zip(P, self._tests, strict=True):
            row[list(test.terms)] = list(test.terms.values())
        left, right = (np.array(side, dtype=np.int64) for side in self._children)
        return left, right, P, v

    def _put(self, slot: Slot, reference: int) -> None:
        node, side = slot
        if node >= 0:
            self._children[side][node] = reference
