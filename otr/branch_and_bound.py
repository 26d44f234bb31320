"""Whether a linear condition on state and action holds: branch and bound over pieces of leaves' regions.

On a piece the condition's left side is bounded by an affine function, whose largest value a linear program finds. Its
multipliers are the proof, which is checked without a solver.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.arrays import FloatArray, IntArray
from otr.domain import Domain
from otr.errors import CertificateError, OtrError
from otr.head import ClipBox, Sign, TanhBox
from otr.head_lines import half_and_middle, limits_of_head, line_above
from otr.linear_programs import Bases, Rows, largest_balls, largest_values
from otr.regions import leaf_rows
from otr.tree import ObliqueTree

__all__ = ["Condition", "Piece", "Search", "Verdict"]

_THIN = 1e-9  # radius, in the box's scale, of a ball that counts as none
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Condition:
    """A linear condition on state and action: ``state @ x + action @ u <= bound``.

    In a tree with labels, u is 1 at the label and 0 elsewhere; of a sign head it is the label, 0 or 1.
    """

    state: ArrayLike
    action: ArrayLike
    bound: float


@dataclass(frozen=True)
class Piece:
    """A part of a leaf's region on which the condition is proved, or that is empty.

    Attributes:
        leaf: the leaf.
        low, high: limits of the outputs that the condition weighs, in order.
        rows, multipliers: of its rows, by index: the domain's sides, the leaf's tests, these limits.
        is_empty: the sum of these rows, each of which is 0 or more in the piece, is nowhere above nearly nothing; else
            the sum and a bound on the condition's left side are nowhere above what is allowed.
    """

    leaf: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    rows: tuple[int, ...]
    multipliers: tuple[float, ...]
    is_empty: bool


@dataclass(frozen=True)
class Verdict:
    """Whether a condition holds on a box.

    Attributes:
        holds: whether it does.
        value: where it holds, a bound on ``state @ x + action @ u`` over the box, to within the tolerance the largest
            value; else the value at the state found.
        leaf: the leaf where that is.
        state, action: (d,), (o,) a state where the condition fails, and the tree's action there; None where it holds.
        pieces: the proof that it holds, which `otr.check_verdict` checks.
        tolerance: what the condition may fail by all the same, under tanh.
    """

    holds: bool
    value: float
    leaf: int
    state: FloatArray | None
    action: FloatArray | None
    pieces: tuple[Piece, ...]
    tolerance: float


class Search:
    """The question about one tree, one condition and one box."""

    def __init__(self, tree: ObliqueTree, condition: Condition, domain: Domain, tolerance: float) -> None:
        """Take the arguments of `otr.find_violation`; the domain is bounded."""
        self.tree, self.domain, self.tolerance = tree, domain, tolerance
        self.state, self.action = (np.asarray(part, dtype=np.float64) for part in (condition.state, condition.action))
        self.bound = float(condition.bound)
        if self.state.shape != (tree.n_inputs,) or self.action.shape != (tree.n_outputs,):
            raise ValueError(
                f"the condition has coefficients of shape {self.state.shape} and {self.action.shape}, expected "
                f"({tree.n_inputs},) of the state and ({tree.n_outputs},) of the action"
            )
        if not (np.isfinite(self.state).all() and np.isfinite(self.action).all() and np.isfinite(self.bound)):
            raise ValueError("the condition has a coefficient or a bound that is no finite number")
        self.rows, self.signs = leaf_rows(tree, domain, np.arange(tree.n_leaves))
        self.weighed = np.flatnonzero(self.action) if tree.labels is None else np.zeros(0, dtype=np.int64)
        self.outputs = np.concatenate((tree.M, tree.c[:, :, None]), axis=2)[:, self.weighed]

    def run(self, max_pieces: int) -> Verdict:
        """Return the answer."""
        leaves, pieces = self._leaves_with_an_inside()
        leaves, low, high = self._first_pieces(leaves, max_pieces)
        largest, where = -np.inf, 0
        while len(leaves):
            if len(pieces) + len(leaves) > max_pieces:
                raise OtrError(f"the question needs more than {max_pieces:,} pieces; ask about a smaller box")
            rows, signs, objectives = self._programs(leaves, low, high)
            best = largest_values(rows, np.arange(len(leaves)), signs, objectives)
            states = np.clip(self.domain.unscaled(best.states), self.domain.low, self.domain.high)
            found = np.where(np.isfinite(best.values), self._values(leaves, states), -np.inf)
            worst = int(found.argmax())
            if found[worst] > self.bound:
                action = self._actions(leaves[worst : worst + 1], states[worst : worst + 1])[0]
                value, leaf = float(found[worst]), int(leaves[worst])
                return Verdict(False, value, leaf, states[worst], action, (), self.tolerance)
            empty = np.flatnonzero(~np.isfinite(best.values))
            pieces += self._empty_pieces(rows, signs, empty, leaves, low, high)
            proved = np.isfinite(best.values) & (best.values <= np.maximum(self.bound, found + self.tolerance))
            for i in np.flatnonzero(proved).tolist():
                pieces.append(_piece(leaves, low, high, i, best.rows[i], best.multipliers[i], is_empty=False))
                if best.values[i] > largest:
                    largest, where = float(best.values[i]), int(leaves[i])
            left = np.flatnonzero(np.isfinite(best.values) & ~proved)
            leaves, low, high = self._cut(leaves[left], low[left], high[left], states[left])
        return Verdict(True, largest, where, None, None, tuple(pieces), self.tolerance)

    def check(self, verdict: Verdict) -> None:
        """Raise CertificateError unless the answer is shown."""
        if not verdict.holds:
            self._check_failure(verdict)
            return
        pieces = verdict.pieces
        by_leaf: dict[int, list[Piece]] = {}
        for piece in pieces:
            by_leaf.setdefault(piece.leaf, []).append(piece)
        for leaf in range(self.tree.n_leaves):
            if not _covers(by_leaf.get(leaf, []), *self._limits_of(leaf)):
                raise CertificateError(f"leaf {leaf}: the pieces of the proof do not cover it")
        leaves = np.array([piece.leaf for piece in pieces], dtype=np.int64)
        low = np.array([piece.low for piece in pieces]).reshape(len(pieces), -1)
        high = np.array([piece.high for piece in pieces]).reshape(len(pieces), -1)
        rows, signs, objectives = self._programs(leaves, low, high)
        for i, piece in enumerate(pieces):
            at, weights = np.array(piece.rows, dtype=np.int64), np.array(piece.multipliers)
            well_formed = at.shape == weights.shape and (weights >= 0).all() and (at >= 0).all()
            if not (well_formed and (at < rows.n_rows).all() and (signs[i, at] != 0).all()):
                raise CertificateError(f"leaf {piece.leaf}: the multipliers of a piece are not those of its rows")
            forms = np.column_stack((rows.a[i, at], rows.b[i, at])) * signs[i, at][:, None]
            total = weights @ forms if piece.is_empty else weights @ forms + objectives[i]
            highest = float(total[-1] + self.domain.reach(total[:-1]))
            allowed = _THIN * max(1.0, float(weights.sum())) if piece.is_empty else self.bound + self.tolerance
            if not highest <= allowed + _ROUNDING * max(1.0, float(np.abs(objectives[i]).max())):
                raise CertificateError(f"leaf {piece.leaf}: a piece allows {highest:.6g}, more than {allowed:.6g}")

    def _check_failure(self, verdict: Verdict) -> None:
        """Check that the state lies in the box and fails the condition, under the tree's own answer or the leaf's."""
        x = verdict.state
        outside = x is None or bool(((x < self.domain.low - _ROUNDING) | (x > self.domain.high + _ROUNDING)).any())
        if x is None or outside or not self._values(np.array([verdict.leaf]), x[None])[0] > self.bound:
            raise CertificateError(f"leaf {verdict.leaf}: the condition does not fail at the state {x}")

    def _leaves_with_an_inside(self) -> tuple[IntArray, list[Piece]]:
        """Return the leaves whose regions have an inside, and the proofs that the others have none."""
        n = self.tree.n_leaves
        balls = largest_balls(self.rows, np.arange(n), self.signs, Bases.start(n, self.tree.n_inputs), _THIN)
        empty = np.flatnonzero(balls.is_empty)
        both = [self._limits_of(leaf) for leaf in range(n)]
        low, high = (np.array([pair[side] for pair in both]).reshape(n, -1) for side in (0, 1))
        basis, multipliers = balls.bases.rows, balls.bases.multipliers
        pieces = [_piece(np.arange(n), low, high, i, basis[i], multipliers[i], is_empty=True) for i in empty.tolist()]
        return np.flatnonzero(~balls.is_empty), pieces

    def _empty_pieces(
        self, rows: Rows, signs: NDArray[np.int8], empty: IntArray, leaves: IntArray, low: FloatArray, high: FloatArray
    ) -> list[Piece]:
        """Return the proofs that some of the pieces have no inside."""
        start = Bases.start(len(empty), self.tree.n_inputs)
        bases = largest_balls(rows.take(empty), np.arange(len(empty)), signs[empty], start, _THIN).bases
        return [
            _piece(leaves, low, high, i, bases.rows[at], bases.multipliers[at], is_empty=True)
            for at, i in enumerate(empty.tolist())
        ]

    @cached_property
    def _actions_of_labels(self) -> FloatArray:
        """The actions (n_leaves, o) that the leaves' labels count for."""
        assert self.tree.labels is not None
        if isinstance(self.tree.head, Sign):
            return self.tree.labels[:, None].astype(np.float64)
        actions: FloatArray = np.eye(self.tree.n_outputs)[self.tree.labels]
        return actions

    def _actions(self, leaves: IntArray, states: FloatArray) -> FloatArray:
        """Return the actions (n, o) of leaves at states (n, d)."""
        if self.tree.labels is not None:
            return self._actions_of_labels[leaves]
        outputs = np.einsum("nod,nd->no", self.tree.M[leaves], states) + self.tree.c[leaves]
        return np.asarray(self.tree.head(outputs))

    def _values(self, leaves: IntArray, states: FloatArray) -> FloatArray:
        """Return the condition's left side at states (n, d), each answered by its leaf."""
        values: FloatArray = states @ self.state + self._actions(leaves, states) @ self.action
        return values

    def _limits_of(self, leaf: int) -> tuple[FloatArray, FloatArray]:
        """Return limits (n_weighed,) of the outputs that pieces must cover: under tanh those of interval arithmetic."""
        m = len(self.weighed)
        if not isinstance(self.tree.head, TanhBox) or not m:
            return np.full(m, -np.inf), np.full(m, np.inf)
        forms = self.domain.scaled(self.outputs[leaf])
        reach = self.domain.reach(forms[:, :-1])
        return forms[:, -1] - reach, forms[:, -1] + reach

    def _first_pieces(self, leaves: IntArray, max_pieces: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return leaves and intervals (n, n_weighed) of their outputs: a clip's three parts, else the whole."""
        n, m = len(leaves), len(self.weighed)
        if isinstance(self.tree.head, ClipBox) and m:
            limits = [limits_of_head(self.tree.head, self.tree.n_outputs, int(k)) for k in self.weighed]
            if n * 3**m > max_pieces:
                raise OtrError(f"{m} clipped outputs make {n * 3**m:,} pieces; weigh fewer of them at a time")
            parts = product(*(((-np.inf, a), (a, b), (b, np.inf)) for a, b in limits))
            chosen = np.array(list(parts), dtype=np.float64)
            return np.repeat(leaves, 3**m), np.tile(chosen[..., 0], (n, 1)), np.tile(chosen[..., 1], (n, 1))
        both = [self._limits_of(leaf) for leaf in leaves.tolist()]
        low, high = (np.array([pair[side] for pair in both]).reshape(n, m) for side in (0, 1))
        return leaves, low, high

    def _programs(
        self, leaves: IntArray, low: FloatArray, high: FloatArray
    ) -> tuple[Rows, NDArray[np.int8], FloatArray]:
        """Return rows, signs and objectives of pieces: the largest value of a bound on the condition's left side."""
        n, m = low.shape
        objectives = np.tile(np.append(self.state, 0.0), (n, 1))
        if self.tree.labels is not None:
            objectives[:, -1] += self._actions_of_labels[leaves] @ self.action
        outputs = self.outputs[leaves]
        for i in range(m):
            slope, offset = self._line(i, low[:, i], high[:, i])
            objectives += slope[:, None] * outputs[:, i]
            objectives[:, -1] += offset
        # As tests that go left, low - y <= 0 and y - high <= 0, so that a constant output may lie on the edge.
        sides = np.concatenate((-outputs, outputs), axis=1)
        sides[:, :m, -1] += np.where(np.isfinite(low), low, 0.0)
        sides[:, m:, -1] -= np.where(np.isfinite(high), high, 0.0)
        rows = self.rows.take(leaves).followed_by(self.domain.rows_of(sides))
        used = np.isfinite(np.concatenate((low, high), axis=1))
        signs = np.concatenate((self.signs[leaves], np.where(used, -1, 0).astype(np.int8)), axis=1)
        return rows, signs, self.domain.scaled(objectives)

    def _cut(
        self, leaves: IntArray, low: FloatArray, high: FloatArray, states: FloatArray
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return both halves of each piece, cut in the output whose line is loosest at the state found."""
        if not len(leaves):
            return leaves, low, high
        outputs = self.outputs[leaves]
        y = np.einsum("nod,nd->no", outputs[..., :-1], states) + outputs[..., -1]
        gaps = np.stack([self._gap(i, y[:, i], low[:, i], high[:, i]) for i in range(low.shape[1])], axis=1)
        loosest, each = gaps.argmax(axis=1), np.arange(len(leaves))
        a, b = low[each, loosest], high[each, loosest]
        # Near the state found, but never so near an end that the pieces shrink to nothing.
        cut = np.clip(y[each, loosest], a + 0.1 * (b - a), b - 0.1 * (b - a))
        left_high, right_low = high.copy(), low.copy()
        left_high[each, loosest], right_low[each, loosest] = cut, cut
        return np.concatenate((leaves, leaves)), np.concatenate((low, right_low)), np.concatenate((left_high, high))

    def _line(self, i: int, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slope and offset (n,) of lines above a weighed output's share in the condition, on intervals (n,)."""
        output = int(self.weighed[i])
        return line_above(self.tree.head, self.tree.n_outputs, output, self.action[output], low, high)

    def _gap(self, i: int, y: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return how far the line of a weighed output is above what it bounds, at outputs y (n,)."""
        output = int(self.weighed[i])
        slope, offset = self._line(i, low, high)
        half, middle = half_and_middle(self.tree.head, self.tree.n_outputs, output)
        gap: FloatArray = slope * y + offset - self.action[output] * (middle + half * np.tanh(y))
        return gap


def _piece(
    leaves: IntArray, low: FloatArray, high: FloatArray, i: int, rows: NDArray[np.int16], multipliers: FloatArray,
    *, is_empty: bool,
) -> Piece:  # fmt: skip
    used = np.flatnonzero((rows >= 0) & (multipliers > 0))
    return Piece(
        int(leaves[i]),
        tuple(low[i].tolist()),
        tuple(high[i].tolist()),
        tuple(rows[used].tolist()),
        tuple(multipliers[used].tolist()),
        is_empty,
    )


def _covers(pieces: list[Piece], low: FloatArray, high: FloatArray) -> bool:
    """Return whether pieces make up the box [low, high] of outputs: one that holds it, or the two sides of a cut."""
    if any((np.array(piece.low) <= low).all() and (np.array(piece.high) >= high).all() for piece in pieces):
        return True
    for i in range(len(low)):
        for cut in sorted({piece.high[i] for piece in pieces if low[i] < piece.high[i] < high[i]}):
            below = [piece for piece in pieces if piece.high[i] <= cut]
            above = [piece for piece in pieces if piece.low[i] >= cut]
            if len(below) + len(above) == len(pieces):
                sides = (below, low, np.where(np.arange(len(low)) == i, cut, high)), (
                    above, np.where(np.arange(len(low)) == i, cut, low), high)  # fmt: skip
                return all(_covers(*side) for side in sides)
    return False
