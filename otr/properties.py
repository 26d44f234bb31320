"""Questions about a tree on a box, answered exactly: the range of its actions, and whether a linear condition holds.

Each leaf's region is a polytope and its outputs are affine there, so every question is a linear program a leaf. A head
that clips is affine in pieces; tanh is bounded by lines, and a piece is cut in two where these are too loose
(branch and bound).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from otr.arrays import FloatArray, IntArray
from otr.domain import Box, Domain, as_domain
from otr.errors import OtrError
from otr.head import ClipBox, Head, Sign, TanhBox
from otr.linear_programs import Bases, LargestValues, Rows, largest_balls, largest_values
from otr.regions import leaf_rows
from otr.tree import ObliqueTree

__all__ = ["Condition", "OutputRange", "Verdict", "find_violation", "output_range", "reachable_labels"]

_MAX_PIECES = 2**17


@dataclass(frozen=True)
class OutputRange:
    """The smallest and the largest value of every action on a box, and a state where it is taken, or on whose brink.

    Attributes:
        low, high: (o,) actions.
        low_states, high_states: (o, d).
    """

    low: FloatArray
    high: FloatArray
    low_states: FloatArray
    high_states: FloatArray


@dataclass(frozen=True)
class Condition:
    """A linear condition on state and action: ``state @ x + action @ u <= bound``.

    In a tree with labels, u is 1 at the label and 0 elsewhere; of a sign head it is the label, 0 or 1.
    """

    state: ArrayLike
    action: ArrayLike
    bound: float


@dataclass(frozen=True)
class Verdict:
    """Whether a condition holds on a box.

    Attributes:
        holds: whether it does.
        value: where it holds, a bound on ``state @ x + action @ u`` over the box, to within the tolerance the largest
            value; else the value at the state found.
        leaf: the leaf where that is.
        state, action: (d,), (o,) a state where the condition fails, and the tree's action there; None where it holds.
        n_pieces: regions on each of which a linear program showed that the condition holds.
    """

    holds: bool
    value: float
    leaf: int
    state: FloatArray | None
    action: FloatArray | None
    n_pieces: int


def output_range(tree: ObliqueTree, box: Box | Domain, *, tolerance: float = 1e-9) -> OutputRange:
    """Return the exact minimum and maximum of every action over a box, to the accuracy of a linear program.

    Regions are closed: where the tree jumps at a test, the value on either side counts. Leaves into which no ball of a
    radius above `tolerance` fits, in the box's scale, do not.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, or the tree has labels (then `reachable_labels`
            tells).
    """
    if tree.labels is not None:
        raise ValueError("the tree answers with labels, which have no range; use reachable_labels(tree, box)")
    _require_known_head(tree)
    domain = _bounded(tree, box)
    leaves, rows, signs = _reached(tree, domain, tolerance)
    n, o = len(leaves), tree.n_outputs
    forms = domain.scaled(np.concatenate((tree.M[leaves], tree.c[leaves][:, :, None]), axis=2))
    objectives = np.concatenate((-forms, forms), axis=1).reshape(n * 2 * o, -1)
    best = largest_values(rows, np.repeat(np.arange(n), 2 * o), np.repeat(signs, 2 * o, axis=0), objectives)
    values = best.values.reshape(n, 2 * o)
    at = values.argmax(axis=0)
    states = domain.unscaled(best.states).reshape(n, 2 * o, -1)[at, np.arange(2 * o)]
    low, high = (np.asarray(tree.head(y)) for y in (-values.max(axis=0)[:o], values.max(axis=0)[o:]))
    return OutputRange(low, high, states[:o], states[o:])


def reachable_labels(tree: ObliqueTree, box: Box | Domain | None = None, *, tolerance: float = 1e-9) -> IntArray:
    """Return the labels of the leaves whose regions have an inside in a box, ascending.

    Raises:
        ValueError: the tree has no labels.
    """
    if tree.labels is None:
        raise ValueError("the tree has no labels; use output_range(tree, box)")
    leaves, _, _ = _reached(tree, as_domain(box, tree.n_inputs), tolerance)
    return np.unique(tree.labels[leaves])


def find_violation(
    tree: ObliqueTree,
    condition: Condition,
    box: Box | Domain,
    *,
    tolerance: float = 1e-6,
    max_pieces: int = _MAX_PIECES,
) -> Verdict:
    """Return a proof that a condition holds for all states of a box, or a state where it fails.

    The states are those of the regions with an inside, as in `output_range`.

    Args:
        tree: any tree.
        condition: with coefficients (d,) and (o,).
        box: bounded.
        tolerance: with a tanh head, a condition may be called kept that fails by no more than this.
        max_pieces: refuse to look at more.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, or the condition does not fit the tree.
        OtrError: more than `max_pieces` regions would have to be looked at.
    """
    _require_known_head(tree)
    domain = _bounded(tree, box)
    state, action = (np.asarray(part, dtype=np.float64) for part in (condition.state, condition.action))
    if state.shape != (tree.n_inputs,) or action.shape != (tree.n_outputs,):
        raise ValueError(
            f"the condition has coefficients of shape {state.shape} and {action.shape}, expected ({tree.n_inputs},) of "
            f"the state and ({tree.n_outputs},) of the action"
        )
    return _Search(tree, domain, state, action, float(condition.bound), tolerance, max_pieces).run()


def _require_known_head(tree: ObliqueTree) -> None:
    if not tree.head.acts_by_output:
        raise ValueError(
            f"the head {type(tree.head).__name__} multiplies outputs, which no linear program bounds; "
            "otr.control.constant_gains(tree, X) returns an affine tree with the gains averaged"
        )


def _bounded(tree: ObliqueTree, box: Box | Domain) -> Domain:
    domain = as_domain(box, tree.n_inputs)
    domain.require_bounded()
    return domain


def _reached(tree: ObliqueTree, domain: Domain, tolerance: float) -> tuple[IntArray, Rows, np.ndarray]:
    """Return the leaves with an inside, and the rows and signs of their regions."""
    rows, signs = leaf_rows(tree, domain, np.arange(tree.n_leaves))
    balls = largest_balls(rows, np.arange(tree.n_leaves), signs, Bases.start(tree.n_leaves, tree.n_inputs), tolerance)
    leaves = np.flatnonzero(~balls.is_empty)
    return leaves, rows.take(leaves), signs[leaves]


class _Search:
    """Branch and bound over pieces: a leaf, and an interval for each output that the condition weighs."""

    def __init__(
        self,
        tree: ObliqueTree,
        domain: Domain,
        state: FloatArray,
        action: FloatArray,
        bound: float,
        tolerance: float,
        max_pieces: int,
    ) -> None:
        self.tree, self.domain, self.state, self.action, self.bound = tree, domain, state, action, bound
        self.tolerance, self.max_pieces = tolerance, max_pieces
        self.leaves, self.rows, self.signs = _reached(tree, domain, 1e-9)
        self.weighed = np.flatnonzero(action) if tree.labels is None else np.zeros(0, dtype=np.int64)
        self.outputs = np.concatenate((tree.M, tree.c[:, :, None]), axis=2)[self.leaves]

    def run(self) -> Verdict:
        at, low, high = self._first_pieces()
        largest, where, n_proved = -np.inf, 0, 0
        while len(at):
            if n_proved + len(at) > self.max_pieces:
                raise OtrError(f"the question needs more than {self.max_pieces:,} pieces; ask about a smaller box")
            best = self._solve(at, low, high)
            there = np.flatnonzero(np.isfinite(best.values))
            states = self.domain.unscaled(best.states[there])
            found = self._values(self.leaves[at[there]], states)
            if len(there) and found.max() > self.bound:
                i = int(found.argmax())
                leaf = int(self.leaves[at[there[i]]])
                return Verdict(False, float(found[i]), leaf, states[i], self._answers(leaf, states[i]), n_proved)
            proved = best.values[there] <= np.maximum(self.bound, found + self.tolerance)
            n_proved += int(proved.sum()) + len(at) - len(there)
            if proved.any() and best.values[there][proved].max() > largest:
                i = int(np.argmax(np.where(proved, best.values[there], -np.inf)))
                largest, where = float(best.values[there[i]]), int(self.leaves[at[there[i]]])
            open_ = there[~proved]
            at, low, high = self._cut(at[open_], low[open_], high[open_], states[~proved])
        return Verdict(True, largest, where, None, None, n_proved)

    def _answers(self, leaf: int, state: FloatArray) -> FloatArray:
        if self.tree.labels is not None:
            return np.asarray(self._actions_of_labels[leaf])
        return np.asarray(self.tree.head(self.tree.M[leaf] @ state + self.tree.c[leaf]))

    @cached_property
    def _actions_of_labels(self) -> FloatArray:
        """The actions (n_leaves, o) that the leaves' labels count for."""
        assert self.tree.labels is not None
        if isinstance(self.tree.head, Sign):
            return self.tree.labels[:, None].astype(np.float64)
        actions: FloatArray = np.eye(self.tree.n_outputs)[self.tree.labels]
        return actions

    def _values(self, leaves: IntArray, states: FloatArray) -> FloatArray:
        """Return the condition's left side at states (n, d), each answered by its leaf."""
        if self.tree.labels is not None:
            answers = self._actions_of_labels[leaves]
        else:
            answers = self.tree.head(np.einsum("nod,nd->no", self.tree.M[leaves], states) + self.tree.c[leaves])
        values: FloatArray = states @ self.state + answers @ self.action
        return values

    def _first_pieces(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return leaves, by index, and intervals (n, n_weighed) of the outputs."""
        n, m = len(self.leaves), len(self.weighed)
        low, high = np.full((n, m), -np.inf), np.full((n, m), np.inf)
        if isinstance(self.tree.head, ClipBox):
            limits = [_limits(self.tree.head, self.tree.n_outputs, int(k)) for k in self.weighed]
            intervals = [((-np.inf, a), (a, b), (b, np.inf)) for a, b in limits]
            if n * 3**m > self.max_pieces:
                raise OtrError(f"{m} clipped outputs make {n * 3**m:,} pieces; weigh fewer of them at a time")
            chosen = np.array(list(product(*intervals)), dtype=np.float64).reshape(3**m, m, 2)
            return np.repeat(np.arange(n), 3**m), np.tile(chosen[..., 0], (n, 1)), np.tile(chosen[..., 1], (n, 1))
        if isinstance(self.tree.head, TanhBox) and m:
            forms = self.domain.scaled(self.outputs[:, self.weighed])
            group, signs = np.repeat(np.arange(n), 2 * m), np.repeat(self.signs, 2 * m, axis=0)
            both = np.stack((-forms, forms), axis=1).reshape(n * 2 * m, -1)
            reach = largest_values(self.rows, group, signs, both).values.reshape(n, 2, m)
            low, high = -reach[:, 0], reach[:, 1]
        return np.arange(n), low, high

    def _solve(self, at: IntArray, low: FloatArray, high: FloatArray) -> LargestValues:
        """Return the largest value on each piece of an affine bound on the condition's left side."""
        n, m = low.shape
        objective = np.tile(np.append(self.state, 0.0), (n, 1))
        if self.tree.labels is not None:
            objective[:, -1] += self._actions_of_labels[self.leaves[at]] @ self.action
            return largest_values(self.rows, at, self.signs[at], self.domain.scaled(objective))
        outputs = self.outputs[at][:, self.weighed]
        for i in range(m):
            slope, offset = _line(self.tree, int(self.weighed[i]), self.action[self.weighed[i]], low[:, i], high[:, i])
            objective += slope[:, None] * outputs[:, i]
            objective[:, -1] += offset
        # As tests that go left, low - y <= 0 and y - high <= 0, so that a constant output may lie on the edge.
        sides = np.concatenate((-outputs, outputs), axis=1)
        sides[:, :m, -1] += np.where(np.isfinite(low), low, 0.0)
        sides[:, m:, -1] -= np.where(np.isfinite(high), high, 0.0)
        rows = self.rows.take(at).followed_by(self.domain.rows_of(sides))
        used = np.isfinite(np.concatenate((low, high), axis=1))
        signs = np.concatenate((self.signs[at], np.where(used, -1, 0).astype(np.int8)), axis=1)
        return largest_values(rows, np.arange(n), signs, self.domain.scaled(objective))

    def _cut(
        self, at: IntArray, low: FloatArray, high: FloatArray, states: FloatArray
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return both halves of each piece, cut in the output whose line is loosest at the state found."""
        if not len(at):
            return at, low, high
        y = (
            np.einsum("nod,nd->no", self.outputs[at][:, self.weighed, :-1], states)
            + self.outputs[at][:, self.weighed, -1]
        )
        gaps = np.stack(list(self._gaps(y, low, high)), axis=1)
        loosest, each = gaps.argmax(axis=1), np.arange(len(at))
        a, b = low[each, loosest], high[each, loosest]
        # Near the state found, but never so near an end that the pieces shrink to nothing.
        cut = np.clip(y[each, loosest], a + 0.1 * (b - a), b - 0.1 * (b - a))
        left_high, right_low = high.copy(), low.copy()
        left_high[each, loosest], right_low[each, loosest] = cut, cut
        return np.concatenate((at, at)), np.concatenate((low, right_low)), np.concatenate((left_high, high))

    def _gaps(self, y: FloatArray, low: FloatArray, high: FloatArray) -> Iterator[FloatArray]:
        for i, output in enumerate(self.weighed.tolist()):
            slope, offset = _line(self.tree, output, self.action[output], low[:, i], high[:, i])
            half, middle = _half_and_middle(self.tree.head, self.tree.n_outputs, output)
            yield slope * y[:, i] + offset - self.action[output] * (middle + half * np.tanh(y[:, i]))


def _limits(head: Head, n_outputs: int, output: int) -> tuple[float, float]:
    assert isinstance(head, ClipBox | TanhBox)
    low, high = (np.broadcast_to(limit, (n_outputs,)) for limit in (head.low, head.high))
    return float(low[output]), float(high[output])


def _half_and_middle(head: Head, n_outputs: int, output: int) -> tuple[float, float]:
    low, high = _limits(head, n_outputs, output)
    return (high - low) / 2, (high + low) / 2


def _line(
    tree: ObliqueTree, output: int, weight: float, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return slope and offset of a line in y that is nowhere below ``weight * head(y)`` between low and high (n,)."""
    head, n = tree.head, len(low)
    if isinstance(head, ClipBox):
        bottom, top = _limits(head, tree.n_outputs, output)
        inside = np.isfinite(low) & np.isfinite(high)
        constant = np.where(np.isfinite(high), bottom, top)
        return np.where(inside, weight, 0.0), np.where(inside, 0.0, weight * constant)
    if not isinstance(head, TanhBox):
        return np.full(n, weight), np.zeros(n)
    half, middle = _half_and_middle(head, tree.n_outputs, output)
    if weight < 0:  # weight tanh(y) = -weight tanh(-y)
        slope, offset = _tanh_line(-high, -low)
        slope = -slope
    else:
        slope, offset = _tanh_line(low, high)
    scale = abs(weight) * half
    return scale * slope, scale * offset + weight * middle


def _tanh_line(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return slope and offset of a line above tanh between low and high (n,), touching it.

    Above 0 tanh is concave: the tangent in the middle. Below it is convex: the chord. Across 0 the line starts at low
    and touches the concave part, or ends at high if that comes first.
    """
    width = np.maximum(high - low, 1e-300)
    near, far = np.maximum(low, 0.0), high.copy()
    for _ in range(60):  # bisection for the point where the tangent passes through (low, tanh low)
        middle = (near + far) / 2
        beyond = (1 - np.tanh(middle) ** 2) * (middle - low) < np.tanh(middle) - np.tanh(low)
        near, far = np.where(beyond, near, middle), np.where(beyond, middle, far)
    chord = (np.tanh(high) - np.tanh(low)) / width
    concave = low >= 0
    touch = np.where(concave, (low + high) / 2, far)
    tangent = 1 - np.tanh(touch) ** 2
    across = ~concave & (high > 0) & (touch < high * (1 - 1e-9))
    slope = np.where(concave | across, tangent, chord)
    through = np.where(concave | across, touch, low)
    # The bisection's point may be off by rounding: lift the line over the end of the interval, too.
    offset = np.tanh(through) - slope * through
    return slope, np.maximum(offset, np.maximum(np.tanh(low) - slope * low, np.tanh(high) - slope * high))
