"""Exact arithmetic: what float64 numbers stand for, as integers over a power of two.

Every float64 is an integer over a power of two, and so is every sum of products of them: a network's affine maps, a
tree's tests, a state. Python's integers hold the numerators, numpy's object arrays hold these; nothing is rounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from math import gcd, lcm
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree

Integers = NDArray[Any]  # of Python's int
Point = tuple[Fraction, ...]  # a state (d,)


def integers(values: FloatArray) -> tuple[Integers, int]:
    """Return integers and the power k of two that they are over: ``values == integers / 2**k``, exactly."""
    mantissas, exponents = np.frexp(values)
    mantissas, exponents = (mantissas * 2.0**53).astype(np.int64), exponents.astype(np.int64) - 53
    power = max(0, -int(exponents[mantissas != 0].min(initial=0)))
    exact = np.empty(values.shape, dtype=object)
    exact.ravel()[:] = [
        mantissa << (exponent + power) if exponent + power >= 0 else mantissa >> -(exponent + power)
        for mantissa, exponent in zip(mantissas.ravel().tolist(), exponents.ravel().tolist(), strict=True)
    ]
    return exact, power


def without_denominators(row: Sequence[Fraction]) -> tuple[Integers, int]:
    """Return a row times the least common multiple of its denominators, integers (n,), and that multiple."""
    denominator = lcm(*(value.denominator for value in row))
    return np.array([int(value * denominator) for value in row], dtype=object), denominator


def common_integers(parts: Sequence[tuple[Integers, int]], power: int) -> list[Integers]:
    """Return integers over 2**power, which is no smaller than their own powers."""
    return [exact * 2 ** (power - own) for exact, own in parts]


def independent_rows(rows: FloatArray) -> tuple[list[int], FloatArray]:
    """Return rows (r,) that are linearly independent and as many as can be, and all rows as sums of these: (n, r).

    Which ones are is decided exactly; the coefficients are rounded to float64.
    """
    n = len(rows)
    left, _ = integers(rows)
    combinations = np.array([[int(i == j) for j in range(n)] for i in range(n)], dtype=object)
    chosen: list[int] = []
    sums = np.zeros((n, n))
    echelon: list[tuple[int, Integers, Integers]] = []  # column of the pivot, row, as a sum of the given ones
    for i in range(n):
        row, combination = left[i], combinations[i]
        for column, other, of_other in echelon:
            if row[column]:
                factor, own = row[column], other[column]
                row, combination = row * own - other * factor, combination * own - of_other * factor
        columns = np.flatnonzero(row)
        if columns.size:
            common = gcd(*row.tolist(), *combination.tolist())
            echelon.append((int(columns[0]), row // common, combination // common))
            chosen.append(i)
            sums[i, i] = 1.0
        else:
            sums[i] = [float(Fraction(-int(value), int(combination[i]))) for value in combination]
            sums[i, i] = 0.0
    return chosen, sums[:, chosen]


def as_point(state: FloatArray) -> Point:
    """Return a state (d,) of float64 as fractions."""
    return tuple(Fraction(value) for value in state.tolist())


def nearest_state(point: Point) -> FloatArray | None:
    """Return the state (d,) of float64 nearest to a point; None where a number is too large for that."""
    try:
        return np.array([float(value) for value in point])
    except OverflowError:
        return None


def at(forms: Integers, power: int, point: Point) -> list[Fraction]:
    """Return the values of affine forms (m, d + 1), integers over 2**power, at a point."""
    denominator = lcm(*(value.denominator for value in point))
    x = np.array([int(value * denominator) for value in point] + [denominator], dtype=object)
    return [Fraction(int(value), denominator << power) for value in forms @ x]


class ExactUnits:
    """A network's units as exact affine forms of its inputs, integers over 2**power, given the activation pattern."""

    def __init__(self, network: ReluNetwork) -> None:
        """Hold the numbers of a network as integers."""
        self.network = network
        units = network.unit_form()
        self._links, of_links = integers(units.links)
        self._own, self._own_power = integers(np.column_stack((units.inputs, units.offsets)))
        slope, self._slope_power = integers(np.array([network.negative_slope]))
        self._slope = int(slope[0])
        self._layers = list(pairwise((*units.layer_starts, len(units.inputs))))
        self._step = of_links + self._slope_power
        self.power = self._own_power + self._step * (len(self._layers) - 1)

    def forms(self, outcomes: Sequence[bool]) -> Integers:
        """Return the forms [P | v] (n_units, d + 1) of all units up to the first layer that `outcomes` do not feed.

        The outcomes are of the hidden neurons of whole layers, in order, or more; True is above 0.
        """
        gates = np.array([1 << self._slope_power if active else self._slope for active in outcomes], dtype=object)
        forms = np.empty((0, self._own.shape[1]), dtype=object)
        power = self._own_power
        for start, stop in self._layers:
            if start > len(outcomes):
                break
            own = self._own[start:stop]
            if start:  # the layers before are over 2**power, this one over 2**(power + step)
                layer = own * 2 ** (power + self._step - self._own_power)
                layer = layer + (self._links[start:stop, :start] * gates[:start]) @ forms
                forms = np.concatenate((forms * 2**self._step, layer))
                power += self._step
            else:
                forms = own
        return np.asarray(forms * 2 ** (self.power - power))

    def outputs(self, point: Point) -> list[Fraction]:
        """Return the network's affine outputs at a point, in exact arithmetic."""
        return at(self.forms(self.outcomes(point))[self.network.n_hidden :], self.power, point)

    def outcomes(self, point: Point) -> list[bool]:
        """Return whether each hidden neuron is above 0 at a point, in exact arithmetic."""
        outcomes: list[bool] = []
        for start, stop in self._layers[:-1]:
            outcomes += [value > 0 for value in at(self.forms(outcomes)[start:stop], self.power, point)]
        return outcomes


class ExactTree:
    """A tree's tests and leaf maps as integers over 2**power.

    Attributes:
        tests: (n_nodes, d + 1), [P | v].
        maps: (n_leaves, o, d + 1), [M | c].
        power: of two.
    """

    def __init__(self, tree: ObliqueTree) -> None:
        """Hold the numbers of a tree as integers."""
        self.tree = tree
        (P, of_P), (M, of_M) = integers(tree.P_of_basis), integers(tree.M_of_basis)
        if tree.basis is not None:
            basis, of_basis = integers(tree.basis)
            P, M, of_P, of_M = P @ basis, M @ basis, of_P + of_basis, of_M + of_basis
        parts = [(P, of_P), (M, of_M), integers(tree.v), integers(tree.c)]
        self.power = max(power for _, power in parts)
        P, M, v, c = common_integers(parts, self.power)
        self.tests, self.maps = np.column_stack((P, v)), np.concatenate((M, c[:, :, None]), axis=2)

    def leaf(self, point: Point) -> int:
        """Return the leaf that a point reaches."""
        tree, reference = self.tree, 0 if self.tree.n_nodes else ~0
        while reference >= 0:
            (value,) = at(self.tests[reference : reference + 1], self.power, point)
            reference = int((tree.children_right if value > 0 else tree.children_left)[reference])
        return ~reference

    def outputs(self, leaf: int, point: Point) -> list[Fraction]:
        """Return the affine outputs of a leaf at a point."""
        return at(self.maps[leaf], self.power, point)
