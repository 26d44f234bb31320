"""What a tree's outputs change by where a test is decided otherwise, within a given error of its boundary.

A tree that is mapped from a network is continuous: its two sides agree on the boundary of every test, so next to it
they differ by no more than the difference of their slopes allows. Whether they agree is followed down both sides at
once, up to rounding, and where their shapes differ a linear program, of which the multipliers alone are relied on, says
which leaves meet. Of the tests where they do not agree, the tree is said to jump.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from otr.clock import check_time
from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.tree import ObliqueTree
from otr.geometry.regions import leaf_paths

_EPSILON = 2.0**-52
_FARTHEST = 1 / 8  # of a half width, by which points may be moved beyond the box
_DEEPEST = 256  # tests on a path that are followed
_PAIRS = 4  # of nodes, for each leaf, that are compared at most: more are taken for a jump
Rows = tuple[tuple[FloatArray, float], ...]  # forms (d + 1,), each at least minus the number


@dataclass(frozen=True)
class Jumps:
    """Bounds of what is decided otherwise where ``|P[i] @ x + v[i]|`` is at most ``within[i]``.

    Attributes:
        changes: (n_nodes, o), of the outputs where test i is; infinite where the tree jumps, 0 where it cannot be.
        distance: from the tests where the tree jumps, in the inputs (Euclidean), beyond which these bounds hold: no
            such test is decided otherwise; 0 without such tests.
    """

    changes: FloatArray
    distance: float

    @property
    def n_jumps(self) -> int:
        """Number of tests at which the tree jumps."""
        return int(np.isinf(self.changes).any(axis=1).sum())


class _Jump(Exception):
    """The two sides of a test differ on its boundary."""


def reach(forms: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return no less than the largest absolute value of affine forms (..., d + 1) over a box, rounded up."""
    return np.asarray(np.maximum(*highest(np.stack((forms, -forms)), low, high)))


def highest(forms: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return no less than the highest value of affine forms (..., d + 1) over a box, rounded up."""
    a, b = forms[..., :-1], forms[..., -1]
    with np.errstate(invalid="ignore"):
        slack = (len(low) + 4) * _EPSILON * (np.abs(a) @ np.maximum(np.abs(low), np.abs(high)) + np.abs(b))
        return np.asarray(np.maximum(a, 0) @ high + np.minimum(a, 0) @ low + b + slack)


def jumps(tree: ObliqueTree, box: Domain, within: FloatArray, limit: float) -> Jumps:
    """Return the bounds; sides that differ on a boundary by more than `limit` count as a jump.

    Args:
        tree: of a tree with labels every test that can be decided otherwise is a jump.
        box: bounded.
        within: (n_nodes,), at least the rounding of the tests' own numbers.
        limit: of an output.
    """
    return _Search(tree, box, within, limit).run()


class _Search:
    def __init__(self, tree: ObliqueTree, box: Domain, within: FloatArray, limit: float) -> None:
        self.tree, self.within, self.limit = tree, within, limit
        self.tests, self.maps = tree.test_forms, tree.leaf_forms
        half = (box.high - box.low) / 2
        self.low, self.high, self.half = box.low, box.high, half
        # Towards the boundary, along the inputs that vary: a step of P[i] @ x + v[i] is directions[i].
        normals = np.where(half > 0, tree.P, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            self.directions = normals / (normals**2).sum(axis=1, keepdims=True)
            self.lengths = within / np.sqrt((normals**2).sum(axis=1))
        self.changes = np.zeros((tree.n_nodes, tree.n_outputs))
        self.leaves_below: list[list[int]] = [[] for _ in range(tree.n_nodes)]

    def run(self) -> Jumps:
        tree = self.tree
        sure = self._never_decided_otherwise()
        steps = self.within[:, None] * np.abs(self.directions)
        is_near = (steps * (tree.depth + 2) <= _FARTHEST * self.half).all(axis=1)  # NaN is not
        self.directions[~is_near] = 0.0
        self.moved = np.where(is_near[:, None], steps, 0.0).max(axis=0, initial=0.0)  # no test moves a point farther
        beyond = (tree.depth + 2) * self.moved
        self.wide = self.low - beyond, self.high + beyond
        self.changes[~sure] = np.inf
        for node in reversed(range(tree.n_nodes)):
            check_time()
            sides = [self._below(int(side[node])) for side in (tree.children_left, tree.children_right)]
            self.leaves_below[node] = sides[0] + sides[1]
            if not sure[node] and is_near[node] and tree.labels is None and tree.depth <= _DEEPEST:
                self.changes[node] = self._change(node, *sides)
        jumping = np.isinf(self.changes).any(axis=1)
        # A test that is decided otherwise is within its length, and where it is followed a point moves by as much.
        times = 2.0 if tree.labels is None else 1.0
        return Jumps(self.changes, float(times * self.lengths[~sure].max()) if jumping.any() else 0.0)

    def _never_decided_otherwise(self) -> np.ndarray:
        above = highest(-self.tests, self.low, self.high) < -self.within
        below = highest(self.tests, self.low, self.high) < -self.within
        return np.asarray(above | below)

    def _below(self, reference: int) -> list[int]:
        return [~reference] if reference < 0 else self.leaves_below[reference]

    def _change(self, node: int, left: list[int], right: list[int]) -> FloatArray:
        """Return what the outputs change by across a test: by the slopes of both sides, and where these meet."""
        tree, step = self.tree, self.directions[node]
        ours, theirs = (tree.M[leaves] @ step for leaves in (left, right))  # (n, o) each
        slopes = np.maximum(ours.max(axis=0) - theirs.min(axis=0), theirs.max(axis=0) - ours.min(axis=0))
        rounding = (tree.n_inputs + 4) * _EPSILON * (np.abs(tree.M[left + right]) @ np.abs(step)).max(axis=0)
        self.n_left = _PAIRS * len(left + right)
        try:
            children = int(tree.children_left[node]), int(tree.children_right[node])
            apart = self._apart(node, *children, self._rows_above(node))
        except _Jump:
            return np.full(tree.n_outputs, np.inf)
        return np.asarray((np.maximum(slopes, 0) + 2 * rounding) * self.within[node] * (1 + 4 * _EPSILON) + apart)

    def _rows_above(self, node: int) -> Rows:
        """Return the tests above a node as rows, with what they may be below 0 by at points that were moved."""
        tree, rows = self.tree, list[tuple[FloatArray, float]]()
        while True:
            parents = np.flatnonzero((tree.children_left == node) | (tree.children_right == node))
            if not parents.size:
                return tuple(rows)
            below, node = node, int(parents[0])
            sign = -1.0 if tree.children_left[node] == below else 1.0
            moved = float(self.moved @ np.abs(tree.P[node]))
            rows.append((sign * self.tests[node], (tree.depth + 2) * (float(self.within[node]) + moved)))

    def _apart(self, node: int, left: int, right: int, rows: Rows) -> FloatArray:
        """Return what two subtrees differ by where a test is 0 and rows hold; raise _Jump beyond the limit."""
        self.n_left -= 1
        if self.n_left < 0:
            raise _Jump
        if left < 0 and right < 0:
            return self._leaves_apart(node, ~left, ~right, rows)
        tree = self.tree
        if left >= 0 and right >= 0:
            same, flipped = self._same_test(node, left, right)
            if same:
                sides = (tree.children_right, tree.children_left) if flipped else (
                    tree.children_left, tree.children_right)  # fmt: skip
                others = int(sides[0][right]), int(sides[1][right])
                below = self._apart(node, int(tree.children_left[left]), others[0], self._with(rows, left, -1.0))
                above = self._apart(node, int(tree.children_right[left]), others[1], self._with(rows, left, 1.0))
                return np.maximum(below, above) + self._crossed(left)
        of_left = left >= 0
        split = left if of_left else right
        test, width = self.tests[split], float(self.within[split])
        changes: list[FloatArray] = []
        highest_of_sides = [self._highest(node, sign * test, rows) for sign in (-1.0, 1.0)]
        if max(highest_of_sides) == -np.inf:
            return np.zeros(tree.n_outputs)
        for most, sign, children in zip(highest_of_sides, (-1.0, 1.0), (tree.children_left, tree.children_right),
                                        strict=True):  # fmt: skip
            if most <= width:  # on this side by no more than the error: the other side alone counts
                continue
            child = int(children[split])
            pair = (child, right) if of_left else (left, child)
            changes.append(self._apart(node, *pair, self._with(rows, split, sign)))
        if not changes:  # at its boundary throughout
            child = int(tree.children_left[split])
            changes = [self._apart(node, *((child, right) if of_left else (left, child)), rows)]
        crossed = self._crossed(split) if len(changes) == 1 else 0.0
        return np.asarray(np.max(changes, axis=0) + crossed)

    def _with(self, rows: Rows, node: int, sign: float) -> Rows:
        return (*rows, (sign * self.tests[node], float(self.within[node])))

    def _crossed(self, node: int) -> FloatArray:
        """Return what a test changes that is within its error; of a jump, nothing: its distance is excepted."""
        change = self.changes[node]
        return np.asarray(np.where(np.isinf(change), 0.0, change))

    def _same_test(self, node: int, left: int, right: int) -> tuple[bool, bool]:
        """Return whether two tests are the same where test `node` is 0, and whether their sides are swapped."""
        weights = np.append(self.half, 1.0)
        columns = np.stack((self.tests[left], self.tests[node]), axis=1)
        scale, along = np.linalg.lstsq(columns * weights[:, None], self.tests[right] * weights, rcond=None)[0]
        rest = self._rest(self.tests[right], (scale, self.tests[left]), (along, self.tests[node]))
        return bool(rest <= abs(scale) * self.within[left] and scale != 0), bool(scale < 0)

    def _leaves_apart(self, node: int, left: int, right: int, rows: Rows) -> FloatArray:
        test, apart = self.tests[node], np.zeros(self.tree.n_outputs)
        weights = np.append(self.half, 1.0)
        for output in range(self.tree.n_outputs):
            difference = self.maps[right, output] - self.maps[left, output]
            size = np.abs(self.maps[[left, right], output]).max(axis=0)
            along = float((weights * difference) @ (weights * test) / ((weights * test) @ (weights * test)))
            apart[output] = self._rest(difference, (along, test), size=size)
            if apart[output] > self.limit:
                both = [self._highest(node, sign * difference, rows) for sign in (1.0, -1.0)]
                apart[output] = max(0.0, *both) + float(reach(_EPSILON * size, *self.wide))
            if apart[output] > self.limit:
                raise _Jump
        return apart

    def _rest(self, form: FloatArray, *parts: tuple[float, FloatArray], size: FloatArray | None = None) -> float:
        """Return the reach of a form less multiples of others, with the rounding of the subtraction."""
        sizes = np.abs(form) + sum(np.abs(factor * part) for factor, part in parts)
        sizes = sizes if size is None else np.maximum(sizes, size)
        rest = form - sum(factor * part for factor, part in parts)
        largest = np.maximum(np.abs(self.wide[0]), np.abs(self.wide[1]))
        return float(reach(rest, *self.wide) + 4 * _EPSILON * (sizes @ np.append(largest, 1.0)))

    def _highest(self, node: int, form: FloatArray, rows: Rows) -> float:
        """Return a bound on a form where test `node` is 0 and rows hold, -inf if nothing is there; by weak duality.

        The program decides the multipliers alone: with any, the bound holds.
        """
        test, d = self.tests[node], self.tree.n_inputs
        free = float(highest(form, *self.wide))
        if not rows:
            return min(free, self._bound(form, node, (), np.zeros(0)))
        forms = np.array([row for row, _ in rows])
        bounds = list(zip(*self.wide, strict=True))
        from scipy.optimize import linprog  # imported where it is used: a fifth of a second

        found = linprog(-form[:d], -forms[:, :d], forms[:, d] + [slack for _, slack in rows], test[None, :d],
                        -test[d:], bounds)  # fmt: skip
        if found.status == 0:
            return min(free, self._bound(form, node, rows, -found.ineqlin.marginals))
        if found.status != 2:
            return free
        inner = linprog(np.append(np.zeros(d), -1.0), np.column_stack((-forms[:, :d], np.ones(len(forms)))),
                        forms[:, d] + [slack for _, slack in rows], np.append(test[:d], 0.0)[None], -test[d:],
                        [*bounds, (None, 1.0)])  # fmt: skip
        if inner.status == 0 and self._bound(np.zeros(d + 1), node, rows, -inner.ineqlin.marginals) < 0:
            return -np.inf
        return free

    def _bound(self, form: FloatArray, node: int, rows: Rows, multipliers: FloatArray) -> float:
        """Return the highest value of a form plus rows with multipliers, and as much of test `node` as lowers it."""
        total, sizes, slack = form.copy(), np.abs(form), 0.0
        for (row, below), multiplier in zip(rows, np.maximum(multipliers, 0.0).tolist(), strict=True):
            total, sizes, slack = total + multiplier * row, sizes + np.abs(multiplier * row), slack + multiplier * below
        weights, test = np.append(self.half, 1.0), self.tests[node]
        best = np.inf
        candidates = [0.0, float((weights * total) @ (weights * test) / ((weights * test) @ (weights * test)))]
        varying = np.flatnonzero(test[:-1] * self.half)
        candidates += (total[varying] / test[varying]).tolist()
        for along in candidates:
            largest = np.maximum(np.abs(self.wide[0]), np.abs(self.wide[1]))
            rounding = (len(rows) + 4) * _EPSILON * ((sizes + np.abs(along * test)) @ np.append(largest, 1.0))
            best = min(best, float(highest(total - along * test, *self.wide) + rounding))
        return best + slack * (1 + 16 * _EPSILON)


def paths_sum(tree: ObliqueTree, changes: FloatArray) -> FloatArray:
    """Return, for every leaf (n_leaves, o), the sum of what the tests on its path change, without jumps."""
    nodes, _ = leaf_paths(tree)
    finite = np.concatenate((np.where(np.isinf(changes), 0.0, changes), np.zeros((1, tree.n_outputs))))
    return np.asarray(finite[nodes].sum(axis=1))
