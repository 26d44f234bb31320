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
from otr.core.pattern_tree import units_and_basis
from otr.core.tree import ObliqueTree

Integers = NDArray[Any]  # of Python's int
Point = tuple[Fraction, ...]  # a state (d,)

_AT_ONCE = 16  # rows


def integers(values: FloatArray) -> tuple[Integers, int]:
    """Return integers and the power k of two that they are over: ``values == integers / 2**k``, exactly."""
    mantissas, exponents = np.frexp(values)
    mantissas, exponents = (mantissas * 2.0**53).astype(np.int64), exponents.astype(np.int64) - 53
    power = power_of(values)
    exact = np.empty(values.shape, dtype=object)
    exact.ravel()[:] = [
        mantissa << (exponent + power) if exponent + power >= 0 else mantissa >> -(exponent + power)
        for mantissa, exponent in zip(mantissas.ravel().tolist(), exponents.ravel().tolist(), strict=True)
    ]
    return exact, power


def power_of(values: FloatArray) -> int:
    """Return the power of two that `integers` puts values over."""
    exponents = np.frexp(values)[1].astype(np.int64) - 53
    return max(0, -int(exponents[values != 0].min(initial=0)))


def without_denominators(row: Sequence[float | Fraction]) -> tuple[Integers, int]:
    """Return a row times a multiple of its denominators, of fractions the least common one, and that multiple."""
    if all(isinstance(value, float) for value in row):
        exact, power = integers(np.array(row))
        return exact, 1 << power
    fractions = [Fraction(value) for value in row]
    denominator = lcm(*(value.denominator for value in fractions))
    return np.array([int(value * denominator) for value in fractions], dtype=object), denominator


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


class Basis:
    """Rows of inputs that exact forms may be sums of: a form [p | v] (r + 1,) stands for ``p @ rows @ x + v``."""

    def __init__(self, rows: FloatArray) -> None:
        """Take the rows (r, d)."""
        self._rows, self.power = integers(rows)

    @property
    def n_rows(self) -> int:
        """Number of rows r."""
        return len(self._rows)

    def products(self, point: Point) -> Point:
        """Return the rows' products with a point."""
        numbers, denominator = without_denominators(point)
        return tuple(Fraction(int(product), denominator << self.power) for product in self._rows @ numbers)

    def along(self, way: Integers) -> Integers:
        """Return the rows' products with p, and s, of integers (p, s): (r + 1,), times 2**power."""
        return np.append(self._rows @ way[:-1], way[-1] << self.power)

    def written_out(self, forms: Integers) -> Integers:
        """Return forms (..., r + 1) in the inputs, (..., d + 1): times 2**power."""
        p = forms[..., :-1] @ self._rows
        return np.concatenate((p, forms[..., -1:] * 2**self.power), axis=-1)


class LazyForms:
    """Affine forms, rows of float64, as integers over 2**power, made when they are asked for."""

    def __init__(self, linear: FloatArray, offsets: FloatArray, basis: FloatArray | None = None) -> None:
        """Take linear parts (n, ..., r) and offsets (n, ...); of ``basis @ x`` they are written out."""
        self._linear, self._offsets, self._made = linear, offsets, dict[int, Integers]()
        self._basis = None if basis is None else Basis(basis)
        of_linear = power_of(linear) + (0 if self._basis is None else self._basis.power)
        self.power = max(of_linear, power_of(offsets))

    def raise_to(self, power: int) -> None:
        """Let the forms be over a larger power of two."""
        self.power, self._made = power, {}

    def __getitem__(self, at: int | tuple[int, int]) -> Integers:
        """Return the forms of a row (..., r + 1), or one of them (r + 1,)."""
        if isinstance(at, tuple):
            return np.asarray(self[at[0]][at[1]])
        block, row = divmod(int(at), _AT_ONCE)
        made = self._made.get(block)
        if made is None:
            rows = slice(block * _AT_ONCE, (block + 1) * _AT_ONCE)
            made, power = integers(np.concatenate((self._linear[rows], self._offsets[rows][..., None]), axis=-1))
            if self._basis is not None:
                made, power = self._basis.written_out(made), power + self._basis.power
            made = self._made[block] = made * 2 ** (self.power - power)
        return np.asarray(made[row])


class ExactUnits:
    """A network's units as exact affine forms of its inputs, integers over 2**power, given the activation pattern."""

    def __init__(self, network: ReluNetwork, basis: Basis | None = None) -> None:
        """Hold the numbers of a network as integers; of the basis that `units_and_basis` returns, if that is given."""
        self.network, self.basis = network, basis
        units = network.unit_form() if basis is None else units_and_basis(network)[0]
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
        place = point if self.basis is None else self.basis.products(point)
        return at(self.forms(self.outcomes(point))[self.network.n_hidden :], self.power, place)

    def outcomes(self, point: Point) -> list[bool]:
        """Return whether each hidden neuron is above 0 at a point, in exact arithmetic."""
        outcomes: list[bool] = []
        place = point if self.basis is None else self.basis.products(point)
        for start, stop in self._layers[:-1]:
            outcomes += [value > 0 for value in at(self.forms(outcomes)[start:stop], self.power, place)]
        return outcomes


class ExactTree:
    """A tree's tests and leaf maps as integers over 2**power.

    Attributes:
        tests: by node, [P | v] (d + 1,).
        maps: by leaf, [M | c] (o, d + 1).
        power: of two.
    """

    def __init__(self, tree: ObliqueTree, basis: Basis | None = None, columns: Sequence[int] = ()) -> None:
        """Hold the numbers of a tree as integers; of a basis (r, d), in which its own has the rows `columns`, r + 1."""
        self.tree, self.basis = tree, basis
        P, M, own = tree.P_of_basis, tree.M_of_basis, tree.basis
        if basis is not None:
            P, M = (_in_columns(part, columns, basis.n_rows) for part in (P, M))
            own = None
        self.tests, self.maps = LazyForms(P, tree.v, own), LazyForms(M, tree.c, own)
        self.raise_to(0)

    def raise_to(self, power: int) -> None:
        """Let all numbers be over 2**power, or a larger power if they need that."""
        self.power = max(power, self.tests.power, self.maps.power)
        self.tests.raise_to(self.power)
        self.maps.raise_to(self.power)

    def values(self, forms: Integers, point: Point) -> list[Fraction]:
        """Return the values of forms (m, d + 1), or (m, r + 1) of a basis, at a point."""
        return at(forms, self.power, point if self.basis is None else self.basis.products(point))

    def leaf(self, point: Point) -> int:
        """Return the leaf that a point reaches."""
        tree, reference = self.tree, 0 if self.tree.n_nodes else ~0
        place = point if self.basis is None else self.basis.products(point)
        while reference >= 0:
            (value,) = at(self.tests[reference][None], self.power, place)
            reference = int((tree.children_right if value > 0 else tree.children_left)[reference])
        return ~reference

    def outputs(self, leaf: int, point: Point) -> list[Fraction]:
        """Return the affine outputs of a leaf at a point."""
        return self.values(self.maps[leaf], point)


def _in_columns(linear: FloatArray, columns: Sequence[int], n: int) -> FloatArray:
    """Return linear parts (..., r) as of n rows, of which theirs are some."""
    wider = np.zeros((*linear.shape[:-1], n))
    wider[..., list(columns)] = linear
    return wider
