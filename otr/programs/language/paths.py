"""Paths through a program, each a place in a tree that grows by a test wherever one of them divides."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from otr.arrays import FloatArray, IntArray
from otr.errors import TreeTooLargeError
from otr.programs.language.tokens import Place
from otr.programs.language.values import Affine, Value

__all__ = ["GrowingTree", "Path"]

Slot = tuple[int, int]  # a test node and its side, 0 is left; node -1 is above the root


@dataclass(slots=True)
class Path:
    """One way through the program.

    Attributes:
        slot: where in the tree the path goes on.
        values: what the program's names are worth.
        decided: tests on the way, and whether they went left.
        at: the statement under way.
    """

    slot: Slot
    values: dict[str, Value] = field(default_factory=dict)
    decided: dict[tuple[object, ...], bool] = field(default_factory=dict)
    at: Place = field(default_factory=lambda: Place(1, 1))

    def fork(self, slot: Slot, key: tuple[object, ...], is_left: bool) -> Path:
        """Return the path that goes on at `slot` after a test."""
        return Path(slot, dict(self.values), {**self.decided, key: is_left}, self.at)


class GrowingTree:
    """The tests made so far. A child is made after its parent, so its index is higher."""

    def __init__(self, n_inputs: int, max_leaves: int) -> None:
        self._n_inputs, self._max_leaves = n_inputs, max_leaves
        self._tests: list[Affine] = []
        self._children: list[list[int]] = [[], []]

    def divide(self, path: Path, form: Affine) -> tuple[Path | None, Path | None]:
        """Return how `path` goes on where ``form <= 0`` and where not; None where no input can get.

        No test is made for a constant, nor for one that the path has decided, or whose negative it has.

        Raises:
            TreeTooLargeError: the tree has more than `max_leaves` leaves.
        """
        key = form.key
        outcome = form.offset <= 0 if form.is_constant else path.decided.get(key)
        if outcome is None and path.decided.get(form.times(-1.0).key) is False:  # -form > 0
            outcome = True
        if outcome is not None:
            return (path, None) if outcome else (None, path)
        if len(self._tests) + 2 > self._max_leaves:
            raise TreeTooLargeError(
                f"line {path.at.line}: the program has more than {self._max_leaves} leaves, because every test here is "
                "made on each of the paths that come before it; write it with fewer of them, or raise max_leaves"
            )
        node = len(self._tests)
        self._put(path.slot, node)
        self._tests.append(form)
        for side in self._children:
            side.append(0)
        return path.fork((node, 0), key, True), path.fork((node, 1), key, False)

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
