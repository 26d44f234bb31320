"""Whether a linear condition on state and action holds: branch and bound over pieces of leaves' regions.

On a piece the condition's left side is bounded by an affine function, whose largest value a linear program finds; where
tanh's lines are too loose the piece is cut in two. What floating point finds counts when exact arithmetic confirms it
(`otr.proof.verdict`); else the piece is decided by a program in rational arithmetic, however thin it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from math import prod

import numpy as np
from numpy.typing import NDArray

from otr.clock import check_time
from otr.core.arrays import FloatArray, IntArray
from otr.core.half_spaces import HalfSpaces
from otr.errors import CertificateError, OtrError
from otr.geometry.largest_values import LargestValues, largest_values
from otr.geometry.rational import Point, as_point, without_denominators
from otr.geometry.regions import leaf_rows, leaves_at_once
from otr.proof.certificate import Sum
from otr.proof.exact_cells import decide
from otr.proof.exact_rows import ExactRow, rounded_up
from otr.proof.verdict import Inequality, Question, Verdict


@dataclass(frozen=True)
class _Open:
    """Pieces that are still to be proved: leaves (n,) and limits of the weighed outputs (n, n_weighed)."""

    leaves: IntArray
    low: FloatArray
    high: FloatArray

    def take(self, at: IntArray | slice) -> _Open:
        """Return some of the pieces."""
        return _Open(self.leaves[at], self.low[at], self.high[at])

    def split(self, n: int) -> tuple[_Open, _Open]:
        """Return the first n pieces, and the others."""
        return self.take(slice(n)), self.take(slice(n, None))

    def followed_by(self, other: _Open) -> _Open:
        """Return the pieces of both."""
        both = zip((self.leaves, self.low, self.high), (other.leaves, other.low, other.high), strict=True)
        return _Open(*(np.concatenate(parts) for parts in both))


class Search:
    """The search for the answer to a question."""

    def __init__(self, question: Question, tolerance: float) -> None:
        """Keep a question, and by how much a condition may fail under tanh."""
        self.question, self.tolerance = question, tolerance
        self.tree, self.domain, self.weighed = question.tree, question.domain, question.weighed
        self.n_proved = 0
        self.outputs = self.tree.leaf_forms[:, self.weighed]

    def reached(self) -> str:
        """Return the progress of the search, as text."""
        return f"{self.n_proved:,} pieces of {self.question.n_leaves:,} leaves were proved, and no state was found"

    def run(self, max_pieces: int) -> Verdict:
        """Return the answer; raise OtrError if more than `max_pieces` pieces would have to be looked at."""
        waiting, pieces = self._first_pieces(max_pieces), list[Inequality]()
        bounds = dict[int, Fraction]()  # of pieces that states may be in, by their place
        while len(waiting.leaves):
            if len(pieces) + len(waiting.leaves) > max_pieces:
                raise OtrError(f"the question needs more than {max_pieces:,} pieces; ask about a smaller box")
            waiting, later = waiting.split(leaves_at_once(self.tree, self.domain))
            rows, signs, objectives, lines = self._programs(waiting)
            best = largest_values(rows, np.arange(len(waiting.leaves)), signs, objectives)
            states = np.clip(self.domain.unscaled(best.states), self.domain.low, self.domain.high)
            failure = self._failure_among(waiting.leaves, states)
            if failure is not None:
                return self._failed(failure)
            to_cut = []
            for i, leaf in enumerate(waiting.leaves.tolist()):
                check_time()
                piece = Inequality(
                    leaf,
                    tuple(waiting.low[i].tolist()),
                    tuple(waiting.high[i].tolist()),
                    tuple(self._exact_line(at, slope[i], offset[i]) for at, (slope, offset) in enumerate(lines)),
                    self._sum(best, i, leaf, rows),
                    is_empty=False,
                )
                proved = self._settled(piece)
                if isinstance(proved, tuple):
                    if self.question.fails(proved):
                        return self._failed(proved)
                    states[i] = [float(value) for value in proved]
                    to_cut.append(i)
                    continue
                highest = self.question.highest(proved)
                if highest is not None:
                    bounds[len(pieces)] = highest
                pieces.append(proved)
                self.n_proved += 1
            at = np.array(to_cut, dtype=np.int64)
            waiting = later.followed_by(self._cut(waiting.take(at), states[at]))
        value, where = -math.inf, 0  # of no state, where nothing is given
        for place in sorted(bounds, key=bounds.__getitem__, reverse=True):
            pieces[place] = self._empty_or_same(pieces[place])
            if not pieces[place].is_empty:
                value, where = rounded_up(bounds[place]), pieces[place].leaf
                break
        return Verdict(True, value, where, None, None, None, tuple(pieces), self.tolerance)

    def _empty_or_same(self, piece: Inequality) -> Inequality:
        """Return the piece, with the proof that no state is in it where there is one."""
        found = decide(self.question.rows(piece.leaf, piece.low, piece.high), self.tree.n_inputs)
        if isinstance(found, tuple):
            return piece
        return replace(piece, proof=Sum(tuple(found), tuple(found.values())), is_empty=True)

    def _settled(self, piece: Inequality) -> Inequality | Point:
        """Return the piece with a proof that holds, or a point of it where its lines allow more than they may."""
        allowed = self.question.allowed(0.0)
        if self._is_shown(piece, allowed):
            return piece
        rows = self.question.rows(piece.leaf, piece.low, piece.high)
        form = self.question.left_side(piece.leaf, piece.lines)
        tolerances = (0.0, self.tolerance) if not self.question.is_exact else (0.0,)
        point: Point | None = None
        for tolerance in tolerances:
            # The rounding of tanh's lines is in what is allowed, too, so that the check finds no more.
            limit = self.question.allowed(tolerance) - (Fraction(tolerance) / 10 if tolerance else 0)
            beyond = form.copy()
            beyond[-1] -= limit * 2**self.question.power
            numbers, denominator = without_denominators(beyond.tolist())
            found = decide(rows | {"beyond": ExactRow(numbers, True)}, self.tree.n_inputs)
            if isinstance(found, tuple):
                if point is None:  # well inside, if there is an inside, where float64 finds it, too
                    strict = {name: ExactRow(row.numbers, True) for name, row in rows.items()}
                    deeper = decide(strict | {"beyond": ExactRow(numbers, True)}, self.tree.n_inputs)
                    point = deeper if isinstance(deeper, tuple) else found
                continue
            own = found.pop("beyond", Fraction(0)) * denominator
            if not own:
                return replace(piece, proof=Sum(tuple(found), tuple(found.values())), is_empty=True)
            shown = {name: multiplier / own for name, multiplier in found.items()}
            proved = replace(piece, proof=Sum(tuple(shown), tuple(shown.values())))
            if self._is_shown(proved, self.question.allowed(self.tolerance)):
                return proved
        if point is None:
            raise OtrError(
                f"leaf {piece.leaf}: the bound is so near to what the actions come to that rounding hides "
                "which is larger; ask for another bound, or allow a larger tolerance"
            )
        return point

    def _is_shown(self, piece: Inequality, allowed: Fraction) -> bool:
        try:
            highest = self.question.highest(piece)
        except CertificateError:
            return False
        return highest is None or highest <= allowed

    def _failure_among(self, leaves: IntArray, states: FloatArray) -> Point | None:
        """Return a state, of those found, where the condition fails, or None."""
        for state in states:
            check_time()
            if self.question.fails_in_float64(state):
                return tuple(map(Fraction, state.tolist()))
        return None

    def _failed(self, point: Point) -> Verdict:
        """Return the verdict that a condition fails at a point, or at the state of float64 nearest to it."""
        question = self.question
        leaf, value, _ = question.value(point)
        state = np.array([float(value) for value in point])
        exact = as_point(state)
        if question.fails_in_float64(state) and question.leaf(exact) == leaf:
            point, (_, value, _) = exact, question.value(exact)
        action = question.own_action(state)
        return Verdict(False, rounded_up(value), leaf, state, action, point, (), self.tolerance)

    def _sum(self, best: LargestValues, i: int, leaf: int, rows: HalfSpaces) -> Sum:
        """Return the sum of rows, by name, that a linear program ended with."""
        if not np.isfinite(best.values[i]):
            return Sum((), ())
        used = np.flatnonzero((best.rows[i] >= 0) & (best.multipliers[i] > 0))
        at = best.rows[i, used].astype(np.int64)
        weights = best.multipliers[i, used] / rows.lengths[rows.of(np.array([i]))[0], at]
        names = self._names(leaf)
        by_name: dict[str, float] = {}
        for row, weight in zip(at.tolist(), weights.tolist(), strict=True):
            if np.isfinite(weight):
                by_name[names[row]] = by_name.get(names[row], 0.0) + weight
        return Sum(tuple(by_name), tuple(by_name.values()))

    def _names(self, leaf: int) -> list[str]:
        """Return the names of the rows of a leaf's pieces, in the order of `_programs`."""
        of_leaf = list(self.question.rows_of_leaf(leaf))
        filler = [""] * (len(self.domain.sides()[1]) + self.tree.depth - len(of_leaf))  # of shorter paths
        return [
            *of_leaf, *filler, *(f"output {k} low" for k in self.weighed), *(f"output {k} high" for k in self.weighed)
        ]  # fmt: skip

    def _first_pieces(self, max_pieces: int) -> _Open:
        """Return a piece for every leaf and, of actions that are affine in pieces, every combination of these."""
        n, m = self.question.n_leaves, len(self.weighed)
        leaves = np.arange(n)
        if self.question.is_exact:
            parts = [self.question.actions[k].pieces() for k in self.weighed]
            n_parts = prod(map(len, parts))
            if n_parts > 1 and n * n_parts > max_pieces:
                raise OtrError(f"{m} clipped outputs make {n * n_parts:,} pieces; weigh fewer of them at a time")
            low, high = np.array(list(product(*parts)), dtype=np.float64).reshape(n_parts, m, 2).transpose(2, 0, 1)
            return _Open(np.repeat(leaves, n_parts), np.tile(low, (n, 1)), np.tile(high, (n, 1)))
        both = []
        for leaf in leaves.tolist():
            check_time()
            both.append(self.question.limits(leaf))
        low, high = (np.array([pair[side] for pair in both], dtype=np.float64).reshape(n, m) for side in (0, 1))
        return _Open(leaves, low, high)

    def _programs(
        self, waiting: _Open
    ) -> tuple[HalfSpaces, NDArray[np.int8], FloatArray, list[tuple[FloatArray, FloatArray]]]:
        """Return rows, signs and objectives of pieces, the largest value of what lines make of the condition's left
        side, and the lines, slopes and offsets, of each weighed output."""
        leaves, low, high = waiting.leaves, waiting.low, waiting.high
        n, m = low.shape
        objectives = np.tile(np.append(self.question.state, 0.0), (n, 1))
        objectives[:, -1] += [self.question.of_label(leaf) for leaf in leaves.tolist()]
        outputs = self.outputs[leaves]
        lines = [self._line(i, low[:, i], high[:, i]) for i in range(m)]
        for i, (slope, offset) in enumerate(lines):
            objectives += slope[:, None] * outputs[:, i]
            objectives[:, -1] += offset
        # As tests that go left, low - y <= 0 and y - high <= 0, so that a constant output may be on the edge.
        sides = np.concatenate((-outputs, outputs), axis=1)
        sides[:, :m, -1] += np.where(np.isfinite(low), low, 0.0)
        sides[:, m:, -1] -= np.where(np.isfinite(high), high, 0.0)
        of_leaves, of_paths = leaf_rows(self.tree, self.domain, leaves)
        rows = of_leaves.followed_by(self.domain.rows_of(sides))
        used = np.isfinite(np.concatenate((low, high), axis=1))
        signs = np.concatenate((of_paths, np.where(used, -1, 0).astype(np.int8)), axis=1)
        return rows, signs, self.domain.scaled(objectives), lines

    def _cut(self, waiting: _Open, states: FloatArray) -> _Open:
        """Return both halves of each piece, cut in the output whose line is loosest at the state found."""
        leaves, low, high = waiting.leaves, waiting.low, waiting.high
        if not len(leaves):
            return waiting
        outputs = self.outputs[leaves]
        y = np.einsum("nod,nd->no", outputs[..., :-1], states) + outputs[..., -1]
        gaps = np.stack([self._gap(i, y[:, i], low[:, i], high[:, i]) for i in range(low.shape[1])], axis=1)
        loosest, each = gaps.argmax(axis=1), np.arange(len(leaves))
        a, b = low[each, loosest], high[each, loosest]
        # Near the state found, but never so near an end that the pieces shrink to nothing.
        cut = np.clip(y[each, loosest], a + 0.1 * (b - a), b - 0.1 * (b - a))
        left_high, right_low = high.copy(), low.copy()
        left_high[each, loosest], right_low[each, loosest] = cut, cut
        return _Open(
            np.concatenate((leaves, leaves)), np.concatenate((low, right_low)), np.concatenate((left_high, high))
        )

    def _line(self, i: int, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slope and offset (n,) of lines above a weighed output's share in the condition, on intervals (n,)."""
        output = self.weighed[i]
        return self.question.actions[output].line_above(self.question.action[output], low, high)

    def _exact_line(self, i: int, slope: float, offset: float) -> tuple[float, float | Fraction]:
        output = self.weighed[i]
        return self.question.actions[output].exact_line(self.question.action[output], slope, offset)

    def _gap(self, i: int, y: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return how far the line of a weighed output is above what it bounds, at outputs y (n,)."""
        output = self.weighed[i]
        slope, offset = self._line(i, low, high)
        gap: FloatArray = slope * y + offset - self.question.action[output] * self.question.actions[output].near(y)
        return gap
