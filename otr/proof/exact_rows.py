"""The subject of a certificate in exact arithmetic: a tree and a network on a domain, as rows of integers.

A row is an affine form [a | b] that is at least 0, or above 0, where it bounds something. It has a name, which is what
certificates call it: "low i", "high i" for a side of the domain, ``x_i - low_i >= 0`` or ``high_i - x_i >= 0``;
"test i" for a leaf's path at test node i, ``P[i] . x + v[i]`` with the sign of the path; "neuron i" for a test of the
network, in the order of `otr.PatternTree`'s bits, with the sign of its outcome.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import units_and_basis
from otr.core.tree import ObliqueTree
from otr.geometry.rational import Basis, ExactTree, ExactUnits, Integers, Point, common_integers, integers
from otr.geometry.rational_linear_programs import ExactBox
from otr.geometry.regions import leaf_paths

ON_BOUNDARY = Fraction(5e-324)  # the smallest float64 above 0: labels that differ on boundaries between them alone
INFINITE = Fraction(10) ** 999
_BELOW_ZERO = Fraction(-1, 10**30)
_WIDE = 12  # inputs; with rows for their sides the proofs found in floating point often do not hold


class ExactRow(NamedTuple):
    """A row: integers (d + 1,) over a power of two, and whether it must be above 0, not just at it."""

    numbers: Integers
    is_strict: bool


class TreeOnDomain(ExactTree):
    """A tree on a domain in exact arithmetic; rows and forms, and the domain's `sides`, are integers over 2**power."""

    def __init__(
        self,
        tree: ObliqueTree,
        domain: Domain,
        power: int = 0,
        basis: Basis | None = None,
        columns: Sequence[int] = (),
        *,
        in_box: bool = False,
    ) -> None:
        """Hold all numbers as integers over 2**power, which is at least the given one.

        Basis and columns are `ExactTree`'s. With `in_box` the sides of inputs that have two are no rows.
        """
        super().__init__(tree, basis, columns)
        self.domain, self.in_box = domain, in_box
        forms, names = domain.sides(in_box=in_box)
        sides, of_sides = integers(forms)
        self.raise_to(max(power, of_sides))
        self.sides = {
            name: ExactRow(row * 2 ** (self.power - of_sides), False) for name, row in zip(names, sides, strict=True)
        }
        self._paths = leaf_paths(tree)

    def rows_of_leaf(self, leaf: int) -> dict[str, ExactRow]:
        """Return the rows of the leaf's region: the domain's sides and the tests on its path."""
        path = zip(*(of_paths[leaf].tolist() for of_paths in self._paths), strict=True)
        tests = {
            f"test {node}": ExactRow(self.tests[node] if sign > 0 else -self.tests[node], sign > 0)
            for node, sign in path
            if node >= 0
        }
        return self.sides | tests

    def written_out(self, forms: Integers) -> tuple[Integers, int]:
        """Return forms in the inputs, (..., d + 1), and the power of two that they are over."""
        return (
            (forms, self.power)
            if self.basis is None
            else (self.basis.written_out(forms), self.power + self.basis.power)
        )

    @property
    def n_coordinates(self) -> int:
        """Number of coefficients of a form: inputs, or rows of the basis."""
        return self.domain.n_inputs if self.basis is None else self.basis.n_rows

    @property
    def two_limits(self) -> ExactBox:
        """The limits of inputs that have two."""
        is_open = np.isinf(self.domain.low) | np.isinf(self.domain.high)
        low, high = np.where(is_open, -np.inf, self.domain.low), np.where(is_open, np.inf, self.domain.high)
        return ExactBox(low, high)

    @property
    def box(self) -> ExactBox | None:
        """The limits, where these are no rows."""
        return self.two_limits if self.in_box else None

    def stacked(self, rows: dict[str, ExactRow]) -> Integers:
        """Return rows as one array (m, d + 1), in the inputs."""
        numbers = np.array([row.numbers for row in rows.values()], dtype=object)
        return self.written_out(numbers.reshape(len(rows), self.n_coordinates + 1))[0]

    def along(self, forms: Sequence[Integers], way: Integers, denominator: int) -> list[Fraction]:
        """Return ``a . p + b s`` of forms [a | b], of integers (p, s) in the inputs over a denominator."""
        power, place = (
            (self.power, way) if self.basis is None else (self.power + self.basis.power, self.basis.along(way))
        )
        return [Fraction(int(form @ place), denominator << power) for form in forms]

    def is_inside(self, point: Point) -> bool:
        """Return whether a point is in the domain."""
        limits = zip(self.domain.low.tolist(), point, self.domain.high.tolist(), strict=True)
        return all(low <= value <= high for low, value, high in limits)


class TreeAndNetwork(TreeOnDomain):
    """A tree and a network that are claimed to be equal on a domain; `n_tests` counts the network's tests."""

    def __init__(self, tree: ObliqueTree, network: ReluNetwork, domain: Domain, *, in_box: bool = False) -> None:
        """Hold the numbers of all three as integers over one power of two.

        With `in_box` forms are of the rows that network and tree read their inputs by, where these are few and no side
        of the domain is a row.
        """
        self.n_tests = network.n_hidden + network.head.n_tests(network.n_outputs)
        of_products = in_box and not domain.sides(in_box=True)[1]
        rows, columns = _common_basis(tree, network) if of_products else (None, [])
        basis = None if rows is None else Basis(rows)
        self.network, self.units = network, ExactUnits(network, basis)
        super().__init__(tree, domain, self.units.power, basis, columns, in_box=in_box)

    def forms(self, outcomes: Sequence[bool]) -> Integers:
        """Return the forms of all units, in order, up to the first layer that `outcomes` do not feed: (n, d + 1)."""
        return np.asarray(self.units.forms(outcomes) * 2 ** (self.power - self.units.power))

    def pairs(self, outcomes: Sequence[bool]) -> list[tuple[int, int]]:
        """Return, for each of the head's tests, the output asked about and the one subtracted, -1 for none.

        Of the outcomes of all tests, a head's later ones do not count for its earlier ones.
        """
        head, of_head = self.network.head, np.array([outcomes[self.network.n_hidden :]], dtype=np.bool_)
        champions = head.champions(of_head)[0].tolist()
        return [(head.first_challenger + test, champion) for test, champion in enumerate(champions)]

    def head_tests(self, forms: Integers, outcomes: Sequence[bool]) -> list[Integers]:
        """Return the forms of the head's tests, given those of all units."""
        outputs = forms[self.network.n_hidden :]
        return [outputs[i] - outputs[j] if j >= 0 else outputs[i] for i, j in self.pairs(outcomes)]

    def differences(self, leaf: int, forms: Integers, outcomes: Sequence[bool]) -> Integers:
        """Return the forms (m, d + 1) whose largest absolute value is the difference of a leaf and the network.

        Of a tree with labels it is the form by which the network prefers its own label to the leaf's.
        """
        if self.tree.labels is None:
            return np.asarray(forms[self.network.n_hidden :] - self.maps[leaf])
        ours, theirs, scores = int(self.tree.labels[leaf]), self.label(outcomes), self.scores(forms)
        return np.asarray(scores[theirs : theirs + 1] - scores[ours])

    def turned(self, outcomes: Sequence[bool]) -> list[Integers]:
        """Return the forms of all tests, each with the sign that makes it at least 0 where the outcomes hold."""
        padded = [*outcomes, *[False] * (self.n_tests - len(outcomes))]
        forms, n = self.forms(padded[: self.network.n_hidden]), self.network.n_hidden
        tests = [*forms[:n], *self.head_tests(forms, padded)]
        return [test if outcome else -test for test, outcome in zip(tests, padded, strict=True)]

    def scores(self, forms: Integers) -> Integers:
        """Return the forms (n_labels, d + 1) of which the largest has the network's label, of equals the first."""
        outputs = forms[self.network.n_hidden :]
        n_labels = self.network.head.n_labels(len(outputs))
        return np.concatenate((0 * outputs[: n_labels - len(outputs)], outputs))  # of Sign: 0, and the output

    def label(self, outcomes: Sequence[bool]) -> int:
        """Return the label that the network's tests lead to."""
        labels = self.network.head.labels(np.array([outcomes[self.network.n_hidden :]], dtype=np.bool_))
        assert labels is not None
        return int(labels[0])

    def gap(self, point: Point) -> tuple[int, Fraction]:
        """Return the leaf that a point reaches, and the difference of tree and network there; of labels 0 or 1."""
        leaf = self.leaf(point)
        if self.tree.labels is not None:
            return leaf, Fraction(int(self.tree.labels[leaf]) != self.label_at(point))
        both = zip(self.outputs(leaf, point), self.units.outputs(point), strict=True)
        return leaf, max(abs(ours - theirs) for ours, theirs in both)

    def label_at(self, point: Point) -> int:
        """Return the network's label at a point."""
        values = self.values(self.scores(self.forms(self.units.outcomes(point))), point)
        return max(range(len(values)), key=values.__getitem__)

    def unit_at(self, point: Point) -> Fraction:
        """Return what errors are counted in: 1 + the sum of |x_i| over the open inputs, of labels its square."""
        is_open = np.isinf(self.domain.low) | np.isinf(self.domain.high)
        unit = Fraction(1) + sum((abs(point[i]) for i in np.flatnonzero(is_open).tolist()), Fraction(0))
        return unit if self.tree.labels is None else unit**2

    def widths(self) -> list[Fraction]:
        """Return what distances are counted in along each input: 1, or its width in the domain if that is smaller."""
        return [Fraction(width) for width in np.minimum(self.domain.high - self.domain.low, 1.0).tolist()]


class Bounds:
    """Bounds of affine forms over a domain; where it is open, in units of 1 + the sum of |x_i| over the open inputs."""

    def __init__(self, domain: Domain, power: int, basis: Basis | None = None) -> None:
        """Take the forms' power of two: they are integers over 2**power, of a basis (r, d) r + 1 of them."""
        self.is_closed = np.isfinite(domain.low) & np.isfinite(domain.high)
        low, high = (integers(np.where(self.is_closed, limits, 0.0)) for limits in (domain.low, domain.high))
        of_limits = max(low[1], high[1])
        self._low, self._high = common_integers((low, high), of_limits)
        self._unit, self._scale = 2**of_limits, 2 ** (of_limits + power)
        self._basis = basis
        if basis is not None:
            self._scale *= 2**basis.power
            sizes = abs(basis.written_out(np.eye(basis.n_rows, basis.n_rows + 1, dtype=np.int64).astype(object)))
            self._reach = sizes[:, :-1] @ np.maximum(abs(self._low), abs(self._high))  # of each product

    def highest(self, form: Integers, *, is_relative: bool = True, enough: Fraction = _BELOW_ZERO) -> Fraction:
        """Return a bound on the highest value of a form (d + 1,) of integers, in the units above.

        Without `is_relative`, a form that is not constant in the open inputs has no bound. Of products of the inputs, a
        rough bound does where it is no larger than what is `enough`.
        """
        if self._basis is not None:
            reach = abs(form[:-1]) @ self._reach if self.is_closed.all() else 0
            rough = Fraction(int(form[-1] * 2**self._basis.power * self._unit + reach), self._scale)
            if not form[:-1].any() or (self.is_closed.all() and rough <= enough):
                return rough
            form = self._basis.written_out(form)
        f = form[:-1]
        highest = form[-1] * self._unit + (f * np.where(f > 0, self._high, self._low)).sum()
        open_slope = max((abs(slope) for slope in f[~self.is_closed]), default=0)
        if open_slope and not is_relative:
            return INFINITE
        return Fraction(int(max(highest, open_slope * self._unit) if open_slope else highest), self._scale)


def rounded_up(value: Fraction) -> float:
    """Return the smallest float64 that is not below a number; infinite where all are."""
    try:
        nearest = float(value)
    except OverflowError:
        return math.inf if value > 0 else -sys.float_info.max
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


def _common_basis(tree: ObliqueTree, network: ReluNetwork) -> tuple[FloatArray | None, list[int]]:
    """Return the rows (r, d) by which a network reads its inputs, and which of them a tree's basis has; None if not so.

    Trees that are mapped from a network have such a basis (`units_and_basis`).
    """
    _, rows = units_and_basis(network)
    if rows is None or tree.basis is None:
        return None, []
    place = {row.tobytes(): i for i, row in reversed(list(enumerate(rows)))}
    columns = [place.get(row.tobytes(), -1) for row in tree.basis]
    return (None, []) if -1 in columns or len(set(columns)) < len(columns) else (rows, columns)


def is_wide(tree: ObliqueTree, network: ReluNetwork, domain: Domain) -> bool:
    """Return whether a box is of so many inputs that its sides are no rows of proofs."""
    n_tests = tree.depth + network.n_hidden + network.head.n_tests(network.n_outputs)
    return domain.n_bounded >= max(_WIDE, 2 * n_tests // 3)
