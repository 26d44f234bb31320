"""What a certificate is about, in exact arithmetic: a tree and a network on a domain, as rows of integers.

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

from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.geometry.rational import ExactTree, ExactUnits, Integers, Point, at, common_integers, integers
from otr.geometry.regions import leaf_paths

ON_BOUNDARY = Fraction(5e-324)  # the smallest float64 above 0: labels that differ on boundaries between them alone
INFINITE = Fraction(10) ** 999


class ExactRow(NamedTuple):
    """A row: integers (d + 1,) over a power of two, and whether it must be above 0, not just at it."""

    numbers: Integers
    is_strict: bool


class TreeOnDomain(ExactTree):
    """A tree on a domain in exact arithmetic; rows and forms, and the domain's `sides`, are integers over 2**power."""

    def __init__(self, tree: ObliqueTree, domain: Domain, power: int = 0) -> None:
        """Hold all numbers as integers over 2**power, which is at least the given one."""
        super().__init__(tree)
        self.domain = domain
        forms, names = domain.sides()
        sides, of_sides = integers(forms)
        parts = [(self.tests, self.power), (self.maps, self.power), (sides, of_sides)]
        self.power = max(power, self.power, of_sides)
        self.tests, self.maps, sides = common_integers(parts, self.power)
        self.sides = {name: ExactRow(row, False) for name, row in zip(names, sides, strict=True)}
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

    def is_inside(self, point: Point) -> bool:
        """Return whether a point is in the domain."""
        limits = zip(self.domain.low.tolist(), point, self.domain.high.tolist(), strict=True)
        return all(low <= value <= high for low, value, high in limits)

    def values(self, forms: Integers, point: Point) -> list[Fraction]:
        """Return the values of forms (m, d + 1) at a point."""
        return at(forms, self.power, point)


class TreeAndNetwork(TreeOnDomain):
    """A tree and a network that are said to be the same function on a domain; `n_tests` counts the network's tests."""

    def __init__(self, tree: ObliqueTree, network: ReluNetwork, domain: Domain) -> None:
        """Hold the numbers of all three as integers over one power of two."""
        self.network, self.units = network, ExactUnits(network)
        super().__init__(tree, domain, self.units.power)
        self.n_tests = network.n_hidden + network.head.n_tests(network.n_outputs)

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

    def __init__(self, domain: Domain, power: int) -> None:
        """Take the forms' power of two: they are integers over 2**power."""
        self.is_closed = np.isfinite(domain.low) & np.isfinite(domain.high)
        low, high = (integers(np.where(self.is_closed, limits, 0.0)) for limits in (domain.low, domain.high))
        of_limits = max(low[1], high[1])
        self._low, self._high = common_integers((low, high), of_limits)
        self._unit, self._scale = 2**of_limits, 2 ** (of_limits + power)

    def highest(self, form: Integers, *, is_relative: bool = True) -> Fraction:
        """Return a bound on the highest value of a form (d + 1,) of integers, in the units above.

        Without `is_relative`, a form that is not constant in the open inputs has no bound.
        """
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
