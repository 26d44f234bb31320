"""Whether a linear condition on state and action holds on a box: the answer, and its check without a solver.

The proof cuts every leaf's region into pieces by the outputs that the condition weighs. On a piece, lines above the
head's answers make the condition's left side an affine function of the state at most, and a sum of the piece's rows
bounds that function over the box. All but tanh and exp is exact: the numbers are taken as they are stored, and a state
is in a leaf where all tests on its path hold, at most 0 on the left and above 0 on the right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from operator import ge, le

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.tree import ObliqueTree
from otr.errors import CertificateError
from otr.geometry.rational import Integers, Point, as_point
from otr.proof.certificate import Sum
from otr.proof.exact_rows import ExactRow, TreeOnDomain
from otr.proof.head_bounds import action_of


@dataclass(frozen=True)
class HalfSpace:
    """The states with ``P @ x + v`` at most 0, or above 0.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> right = otr.HalfSpace([1], 0.0, is_above=True)  # x > 0
        >>> kept = otr.Condition(state=[-1], action=[1], bound=0, given=(right,))  # there the action is at most x
        >>> otr.find_violation(tree, kept, ([-1], [1])).holds
        True
    """

    P: ArrayLike
    v: float
    is_above: bool


@dataclass(frozen=True)
class Condition:
    """A linear condition on state and action: ``state @ x + action @ u <= bound``, in all half spaces of `given`.

    In a tree with labels, u is 1 at the label and 0 elsewhere; of a sign head it is the label, 0 or 1. Where half
    spaces are given, a tree with a basis counts as its P and M are in float64, multiplied out.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> shrinks = otr.Condition(state=[-1], action=[1], bound=0)  # the action is at most x
        >>> otr.find_violation(tree, shrinks, ([-1], [1])).state
        array([-1.])
    """

    state: ArrayLike
    action: ArrayLike
    bound: float
    given: tuple[HalfSpace, ...] = ()


@dataclass(frozen=True)
class Inequality:
    """The condition as an inequality proved on a part of a leaf's region, or a part that is proved to be empty.

    The lines, slope and offset, are nowhere below the outputs' shares in the condition. The proof sums rows: "low i"
    and "high i" of the box, "test i" of the leaf, "output k low" and "output k high". With what the lines make of the
    condition's left side it is nowhere above what is allowed; of an empty piece it is nowhere above 0, and not 0 where
    the rows hold.
    """

    leaf: int
    low: tuple[float, ...]  # limits of the outputs that the condition weighs, in order
    high: tuple[float, ...]
    lines: tuple[tuple[float, float | Fraction], ...]  # for each, a line above its share
    proof: Sum
    is_empty: bool  # whether no state is in it


@dataclass(frozen=True)
class Verdict:
    """Whether a condition holds at every real point of a box.

    Attributes:
        holds: whether it does.
        value: where it holds, a bound on ``state @ x + action @ u`` over the box: the largest value or, under tanh and
            exp, a number between it and what is allowed; else the value at the state found.
        leaf: the leaf where that is.
        state, action: (d,), (o,) a state where the condition fails, and the tree's own answer there, of which `value`
            is the left side to 1e-9; None where it holds. Where float64 is too coarse for such a state, the nearest to
            `point`, whose action may be of another leaf than `value`.
        point: the state as fractions, at which the condition fails in exact arithmetic; None where it holds.
        pieces: the proof that it holds, which `otr.check_verdict` checks.
        tolerance: by how much the condition may still fail, under tanh and exp.
    """

    holds: bool
    value: float
    leaf: int
    state: FloatArray | None
    action: FloatArray | None
    point: Point | None
    pieces: tuple[Inequality, ...]
    tolerance: float


class Question(TreeOnDomain):
    """A condition asked of a tree on a bounded box, in exact arithmetic."""

    def __init__(self, tree: ObliqueTree, condition: Condition, domain: Domain) -> None:
        """Store the parts; raise ValueError if the condition does not fit the tree or is not finite."""
        super().__init__(_behind(condition.given, tree), domain)
        self.n_leaves = tree.n_leaves  # that are asked about: those after them are outside of what is given
        self.state, self.action = (np.asarray(part, dtype=np.float64) for part in (condition.state, condition.action))
        if self.state.shape != (tree.n_inputs,) or self.action.shape != (tree.n_outputs,):
            raise ValueError(
                f"the condition has coefficients of shape {self.state.shape} and {self.action.shape}, expected "
                f"({tree.n_inputs},) of the state and ({tree.n_outputs},) of the action"
            )
        self.bound = float(condition.bound)
        if not (np.isfinite(self.state).all() and np.isfinite(self.action).all() and np.isfinite(self.bound)):
            raise ValueError("the condition has a coefficient or a bound that is no finite number")
        self.weighed = np.flatnonzero(self.action).tolist() if tree.labels is None else []
        self.actions = {output: action_of(tree.head, tree.n_outputs, output) for output in self.weighed}
        self.is_exact = all(action.is_exact for action in self.actions.values())

    def allowed(self, tolerance: float) -> Fraction:
        """Return what the condition's left side may be."""
        return Fraction(self.bound) + (0 if self.is_exact else Fraction(tolerance))

    def rows(self, leaf: int, low: Sequence[float], high: Sequence[float]) -> dict[str, ExactRow]:
        """Return the rows of a piece, by name."""
        rows = self.rows_of_leaf(leaf)
        for output, least, most in zip(self.weighed, low, high, strict=True):
            for name, limit, sign in (("low", least, 1), ("high", most, -1)):
                if math.isfinite(limit):
                    form = np.array([Fraction(int(value)) for value in self.maps[leaf, output]], dtype=object)
                    form[-1] -= Fraction(limit) * 2**self.power
                    denominator = form[-1].denominator
                    numbers = np.array([int(value * denominator) * sign for value in form], dtype=object)
                    rows[f"output {output} {name}"] = ExactRow(numbers, False)
        return rows

    def left_side(self, leaf: int, lines: Sequence[tuple[float, float | Fraction]]) -> Integers:
        """Return what lines make of the condition's left side in a leaf: fractions (d + 1,), times 2**power."""
        form = np.array([Fraction(value) for value in [*self.state.tolist(), self.of_label(leaf)]], dtype=object)
        form *= 2**self.power
        for output, (slope, offset) in zip(self.weighed, lines, strict=True):
            form += Fraction(slope) * self.maps[leaf, output]
            form[-1] += Fraction(offset) * 2**self.power
        return form

    def of_label(self, leaf: int) -> float:
        """Return a leaf's label's share in the condition; 0 in a tree without labels."""
        if self.tree.labels is None:
            return 0.0
        return float(self.tree.head.weights_of_label(int(self.tree.labels[leaf]), self.tree.n_outputs) @ self.action)

    def value(self, point: Point) -> tuple[int, Fraction, Fraction]:
        """Return a point's leaf, the condition's left side there, and a bound on its error under tanh and exp."""
        leaf = self.leaf(point)
        value = Fraction(self.of_label(leaf))
        value += sum((Fraction(a) * x for a, x in zip(self.state.tolist(), point, strict=True)), Fraction(0))
        off = Fraction(0)
        outputs = self.outputs(leaf, point)
        for output in self.weighed:
            answer, error = self.actions[output].value(outputs[output])
            value += Fraction(self.action[output]) * answer
            off += abs(Fraction(self.action[output])) * error
        return leaf, value, off

    def check(self, verdict: Verdict) -> None:
        """Raise CertificateError unless a verdict is shown."""
        if not verdict.holds:
            self._check_failure(verdict)
            return
        if not 0 <= verdict.tolerance < math.inf:
            raise CertificateError(f"the tolerance is {verdict.tolerance}, expected a number of at least 0")
        by_leaf: dict[int, list[Inequality]] = {}
        for piece in verdict.pieces:
            if {len(piece.low), len(piece.high)} != {len(self.weighed)}:
                raise CertificateError(f"leaf {piece.leaf}: a piece has limits of other outputs than are weighed")
            by_leaf.setdefault(piece.leaf, []).append(piece)
        for leaf in range(self.n_leaves):
            pieces = by_leaf.get(leaf, [])
            if not covers(pieces, *self.limits(leaf)):
                raise CertificateError(f"leaf {leaf}: the pieces of the proof do not cover it", leaf)
            for piece in pieces:
                highest = self.highest(piece)
                if highest is not None and not verdict.value >= highest:
                    raise CertificateError(
                        f"leaf {leaf}: a piece allows {float(highest):.6g}, more than the value {verdict.value}", leaf
                    )
                if highest is not None and highest > self.allowed(verdict.tolerance):
                    raise CertificateError(
                        f"leaf {leaf}: a piece allows {float(highest):.6g}, more than "
                        f"{float(self.allowed(verdict.tolerance)):.6g}",
                        leaf,
                    )

    def limits(self, leaf: int) -> tuple[list[float], list[float]]:
        """Return limits (n_weighed,) of the outputs that pieces must cover: all, or under tanh what the box leaves."""
        if self.is_exact:
            return [-math.inf] * len(self.weighed), [math.inf] * len(self.weighed)
        limits: tuple[list[float], list[float]] = ([], [])
        for output in self.weighed:
            form = self.maps[leaf, output]
            for side, sign in ((0, -1), (1, 1)):
                reach = sign * self._highest(np.asarray(sign * form)) / 2**self.power
                nearest = float(reach)
                outwards = math.nextafter(nearest, sign * math.inf)
                limits[side].append(outwards)
        return limits

    def highest(self, piece: Inequality) -> Fraction | None:
        """Return a bound on the left side in a piece, None if that is empty; raise CertificateError without a proof."""
        leaf, proof = piece.leaf, piece.proof
        m = len(self.weighed)
        sizes = {len(piece.low), len(piece.high), *([] if piece.is_empty else [len(piece.lines)])}
        if sizes != {m}:
            raise CertificateError(f"leaf {leaf}: a piece has lines of other outputs than are weighed", leaf)
        rows = self.rows(leaf, piece.low, piece.high)
        numbers = zip(proof.rows, proof.multipliers, strict=False)
        if len(proof.rows) != len(proof.multipliers) or not all(
            name in rows and 0 <= multiplier < math.inf for name, multiplier in numbers
        ):
            raise CertificateError(f"leaf {leaf}: the multipliers of a piece are not those of its rows", leaf)
        total = np.array([Fraction(0)] * (self.tree.n_inputs + 1), dtype=object)
        for name, multiplier in zip(proof.rows, proof.multipliers, strict=True):
            total += Fraction(multiplier) * rows[name].numbers
        if piece.is_empty:
            highest = self._highest(total)
            used = [rows[name] for name, value in zip(proof.rows, proof.multipliers, strict=True) if value > 0]
            if highest < 0 or (highest == 0 and any(row.is_strict for row in used)):
                return None
            raise CertificateError(f"leaf {leaf}: a piece is said to be empty, but its rows allow states", leaf)
        below = sum((self._line_below(piece, at) for at in range(m)), Fraction(0))
        largest: Fraction = self._highest(total + self.left_side(leaf, piece.lines)) / 2**self.power + below
        return largest

    def _highest(self, form: Integers) -> Fraction:
        """Return the largest value of a form (d + 1,) over the box."""
        highest = Fraction(form[-1])
        for slope, low, high in zip(form[:-1], self.domain.low.tolist(), self.domain.high.tolist(), strict=True):
            highest += slope * Fraction(high if slope > 0 else low)
        return highest

    def _line_below(self, piece: Inequality, at: int) -> Fraction:
        """Return how far, at most, a piece's line is below its share; raise CertificateError beyond rounding."""
        output, (slope, offset) = self.weighed[at], piece.lines[at]
        low, high, weight = piece.low[at], piece.high[at], Fraction(self.action[output])
        if not (math.isfinite(slope) and math.isfinite(offset)):
            raise CertificateError(f"leaf {piece.leaf}: a line of a piece is of no finite numbers", piece.leaf)
        action = self.actions[output]
        is_above = action.stays_above(float(weight), slope, low, high)
        places = {y for y in (low, high) if math.isfinite(y)} | action.turns(float(weight), slope, low, high)
        worst = Fraction(0)
        for y in places:
            answer, error = action.value(Fraction(y))
            short = weight * answer - (Fraction(slope) * Fraction(y) + Fraction(offset))
            is_above = is_above and short <= 10 * abs(weight) * error
            worst = max(worst, Fraction(0) if action.is_exact else short + abs(weight) * error)
        if not is_above:
            raise CertificateError(f"leaf {piece.leaf}: a line of a piece is below what it should bound", piece.leaf)
        return worst

    def _check_failure(self, verdict: Verdict) -> None:
        """Check that the point is in the box and fails the condition under the tree's answer, and the state, too."""
        if verdict.point is None or verdict.state is None or not self.fails(verdict.point):
            raise CertificateError(
                f"leaf {verdict.leaf}: the condition does not fail at the state {verdict.state}", verdict.leaf
            )
        if self.leaf(verdict.point) != verdict.leaf:
            raise CertificateError(f"leaf {verdict.leaf}: the state is not in it", verdict.leaf)
        state = np.array([float(value) for value in verdict.point])
        if verdict.action is None or not (
            np.array_equal(verdict.state, state)
            and np.allclose(verdict.action, self.own_action(state), rtol=1e-9, atol=1e-9)
            and np.isclose(verdict.value, float(self.value(verdict.point)[1]), rtol=1e-9, atol=1e-9)
        ):
            raise CertificateError(
                f"leaf {verdict.leaf}: the verdict has another state, action or value than those of its point",
                verdict.leaf,
            )

    def fails(self, point: Point) -> bool:
        """Return whether the condition fails at a point of the box, beyond the error of a tanh."""
        leaf, value, off = self.value(point)
        return leaf < self.n_leaves and self.is_inside(point) and value - off > Fraction(self.bound)

    def fails_in_float64(self, state: FloatArray) -> bool:
        """Return whether the condition fails at a state (d,) under the tree's own `predict` as in exact arithmetic.

        Both must find the same left side, to 1e-9: on the edge of a test, rounding may send a state over a jump.
        """
        left_side = float(self.state @ state + self.own_action(state) @ self.action)
        point = as_point(state)
        return (
            left_side > self.bound
            and self.fails(point)
            and math.isclose(left_side, float(self.value(point)[1]), rel_tol=1e-9, abs_tol=1e-9)
        )

    def own_action(self, state: FloatArray) -> FloatArray:
        """Return the tree's own answer to a state (d,), as a condition weighs it: (o,)."""
        answer = self.tree.predict(state)
        if self.tree.labels is None:
            return np.asarray(answer, dtype=np.float64)
        return self.tree.head.weights_of_label(int(answer), self.tree.n_outputs)


def _behind(given: Sequence[HalfSpace], tree: ObliqueTree) -> ObliqueTree:
    """Return a tree that first asks for half spaces; states outside of them reach leaves that come after its own."""
    if not given:
        return tree
    k, n = len(given), tree.n_leaves
    P = np.array([half_space.P for half_space in given], dtype=np.float64)
    if P.shape != (k, tree.n_inputs):
        raise ValueError(f"the half spaces have P of shape {P.shape[1:]}, expected ({tree.n_inputs},)")
    inside = np.append(np.arange(1, k), k if tree.n_nodes else ~0)
    outside = ~(n + np.arange(k))
    is_above = np.array([half_space.is_above for half_space in given])
    left, right = (
        np.concatenate((np.where(is_above == is_right, inside, outside), np.where(side >= 0, side + k, side)))
        for is_right, side in ((False, tree.children_left), (True, tree.children_right))
    )
    first = np.zeros(k, dtype=np.int64)
    return ObliqueTree(
        left,
        right,
        np.concatenate((P, tree.P)),
        np.concatenate(([half_space.v for half_space in given], tree.v)),
        np.concatenate((tree.M, tree.M[first])),
        np.concatenate((tree.c, tree.c[first])),
        labels=None if tree.labels is None else np.concatenate((tree.labels, tree.labels[first])),
        head=tree.head,
    )


def covers(pieces: Sequence[Inequality], low: Sequence[float], high: Sequence[float]) -> bool:
    """Return whether pieces make up the box [low, high] of outputs: one that holds it, or the two sides of a cut."""
    waiting = [(pieces, low, high)]
    while waiting:
        pieces, low, high = waiting.pop()
        if any(all(map(le, piece.low, low)) and all(map(ge, piece.high, high)) for piece in pieces):
            continue
        parts = _parted(pieces, low, high)
        if parts is None:
            return False
        waiting += parts
    return True


def _parted(
    pieces: Sequence[Inequality], low: Sequence[float], high: Sequence[float]
) -> list[tuple[Sequence[Inequality], Sequence[float], Sequence[float]]] | None:
    """Return the two sides of a cut that no piece crosses, of pieces and of the box; None if there is none."""
    for i in range(len(low)):
        for cut in sorted({piece.high[i] for piece in pieces if low[i] < piece.high[i] < high[i]}):
            below = [piece for piece in pieces if piece.high[i] <= cut]
            above = [piece for piece in pieces if piece.low[i] >= cut]
            if len(below) + len(above) == len(pieces):
                return [(below, low, [*high[:i], cut, *high[i + 1 :]]), (above, [*low[:i], cut, *low[i + 1 :]], high)]
    return None
