"""Certificates checked, without a solver, in float64 or in rational arithmetic.

Let A be the pattern that a cell of a certificate claims, and z_j^A(x) the pre-activation of neuron j if the neurons
before it behave as in A: an affine function. The proof of neuron j shows ``s_j z_j^A(x) >= -e_j`` in the cell, where
s_j is its sign in A and e_j >= 0 the bound of the remainder. By induction over the neurons,

    |z_j(x) - z_j^A(x)| <= E_j := sum_k |w_jk| D_k,      |a_k(x) - a_k^A(x)| <= D_k := E_k + (1 - negative_slope) e_k,

with w_jk the weight from neuron k to unit j, as the activation is 1-Lipschitz and its two pieces differ by no more
than ``(1 - negative_slope) |z|``. For an output the same sum bounds its distance from the affine map of A, and the
leaf's map is compared with that map's coefficients. A test that splits the leaf's region needs no proof: the cells on
both its sides are there, which are told apart by the sign of z_j^A itself.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.certificate import Cell, Certificate, EmptyLeaf, Sum
from otr.domain import Domain
from otr.errors import CertificateError
from otr.network import ReluNetwork
from otr.regions import LeafPaths, leaf_paths
from otr.tree import ObliqueTree

__all__ = ["verify"]

Numbers = NDArray[Any]  # of float64, or of Fraction as objects
LARGEST_TOLERANCE = 1e-6  # of a certificate that is believed
_LARGEST_MULTIPLIER = 1e100  # so that no sum overflows
_ROUNDING = 1e-13  # of the size of outputs, where float64 checks what was proved in another order or exactly


def verify(certificate: Certificate, tree: ObliqueTree, network: ReluNetwork, *, exact: bool | None = None) -> float:
    """Check that a certificate proves that `tree` computes the same function as `network`, and return the bound.

    Args:
        certificate: of this tree and this network.
        tree: the tree.
        network: the network.
        exact: in rational arithmetic, the numbers taken as they are stored; None: as the certificate was made.

    Returns:
        The bound on the difference, as `Certificate.max_error` is defined; not above it.

    Raises:
        CertificateError: something is not proved; the message names the leaf.
    """
    given = (certificate, tree, network)
    if not all(map(isinstance, given, (Certificate, ObliqueTree, ReluNetwork))):
        names = ", ".join(type(each).__name__ for each in given)
        raise TypeError(f"verify takes a Certificate, an ObliqueTree and a ReluNetwork, got {names}")
    check = _Check(certificate, tree, network, certificate.exact if exact is None else exact)
    return check.run()


class _Check:
    def __init__(self, certificate: Certificate, tree: ObliqueTree, network: ReluNetwork, exact: bool) -> None:
        self.certificate, self.tree, self.network, self.exact = certificate, tree, network, exact
        self.bounds, self.rough_bounds = _Bounds(certificate.domain, exact), _Bounds(certificate.domain, False)
        units = network.unit_form()
        self.links, self.own = self.numbers(units.links), self.numbers(np.column_stack((units.inputs, units.offsets)))
        self.size_of_links = np.abs(self.links)
        self.starts = (*units.layer_starts, len(units.inputs))
        self.tests = self.numbers(np.column_stack((tree.P, tree.v)))
        self.maps = self.numbers(np.concatenate((tree.M, tree.c[:, :, None]), axis=2))
        sides, names = certificate.domain.sides()
        self.sides = dict(zip(names, self.numbers(sides), strict=True))
        self.slope = Fraction(network.negative_slope) if exact else network.negative_slope

    def numbers(self, values: NDArray[np.float64]) -> Numbers:
        """Return float64 values in the arithmetic of the check."""
        return _fractions(values) if self.exact else np.asarray(values, dtype=np.float64)

    def run(self) -> float:
        """Check everything and return the bound on the difference."""
        self._check_fit()
        by_leaf = self._cells_by_leaf()
        empty = {leaf.leaf: leaf for leaf in self.certificate.empty}
        worst: Any = 0
        for leaf in range(self.tree.n_leaves):
            if leaf in empty:
                self._check_empty(empty[leaf])
                continue
            if leaf not in by_leaf:
                raise CertificateError(f"leaf {leaf}: the certificate does not cover it")
            self._check_cover(leaf, by_leaf[leaf], 0)
            for cell in by_leaf[leaf]:
                error = self._error(cell)
                if not error <= self.allowed:
                    raise CertificateError(
                        f"leaf {leaf}: tree and network may differ by {float(error):.3g} where the neurons are "
                        f"{cell.outcomes!r}; the certificate claims {self.certificate.max_error:.3g}"
                    )
                worst = max(worst, error)
        return _rounded_up(worst)

    @cached_property
    def allowed(self) -> Any:
        claimed = self.certificate.max_error
        if self.exact:
            return Fraction(claimed)
        size = max(self.bounds.size(form) for forms in self.maps for form in forms)
        return claimed + _ROUNDING * float(size)

    def _check_fit(self) -> None:
        tree, network, domain = self.tree, self.network, self.certificate.domain
        shapes = {(tree.n_inputs, tree.n_outputs), (network.n_inputs, network.n_outputs)}
        if shapes != {(domain.n_inputs, tree.n_outputs)} or tree.head != network.head:
            raise CertificateError(
                f"the tree has {tree.n_inputs} inputs, {tree.n_outputs} outputs and the head {tree.head!r}, the "
                f"network {network.n_inputs}, {network.n_outputs} and {network.head!r}, the domain {domain.n_inputs} "
                "inputs"
            )
        tolerance, max_error = self.certificate.tolerance, self.certificate.max_error
        if not (0 <= tolerance <= LARGEST_TOLERANCE and 0 <= max_error < math.inf):
            raise CertificateError(
                f"leaf 0: the certificate has the tolerance {tolerance} and the error {max_error}, expected a "
                f"tolerance of at most {LARGEST_TOLERANCE} and a finite error; what it calls empty may hold anything"
            )
        if tree.n_leaves != self.certificate.n_leaves:
            raise CertificateError(
                f"leaf {min(tree.n_leaves, self.certificate.n_leaves)}: the tree has {tree.n_leaves} leaves, the "
                f"certificate is of one with {self.certificate.n_leaves}"
            )

    def _cells_by_leaf(self) -> dict[int, list[Cell]]:
        n_tests = self.network.n_hidden + self.network.head.n_tests(self.network.n_outputs)
        by_leaf: dict[int, list[Cell]] = {}
        for cell in self.certificate.cells:
            well_formed = (
                0 <= cell.leaf < self.tree.n_leaves
                and len(cell.outcomes) == n_tests
                and set(cell.outcomes) <= {"0", "1"}
                and list(cell.splits) == sorted(set(cell.splits))
                and all(0 <= split < n_tests for split in cell.splits)
                and len(cell.proofs) == n_tests - len(cell.splits)
            )
            if not well_formed:
                raise CertificateError(f"leaf {cell.leaf}: the cell {cell.outcomes!r} is not one of this network's")
            by_leaf.setdefault(cell.leaf, []).append(cell)
        return by_leaf

    def _check_cover(self, leaf: int, cells: list[Cell], after: int) -> None:
        """Check that the cells are all of a leaf's region: both sides of every test that splits it, and so on."""
        firsts = {next((split for split in cell.splits if split >= after), None) for cell in cells}
        if firsts == {None} and len(cells) == 1:
            return
        if len(firsts) != 1 or None in firsts:
            raise CertificateError(f"leaf {leaf}: its cells do not cover it; the tests that split it disagree")
        (test,) = firsts
        assert test is not None
        shared = {cell.outcomes[after:test] for cell in cells}
        sides = [[cell for cell in cells if cell.outcomes[test] == outcome] for outcome in "01"]
        if len(shared) != 1 or not all(sides):
            raise CertificateError(f"leaf {leaf}: its cells do not cover it; one side of test {test} is missing")
        for side in sides:
            self._check_cover(leaf, side, test + 1)

    def _error(self, cell: Cell) -> Any:
        """Return the bound on the difference of tree and network in a cell."""
        outcomes = np.array([outcome == "1" for outcome in cell.outcomes])
        n, head = self.network.n_hidden, self.network.head
        forms = self._forms(outcomes[:n])
        pairs = self._pairs_of_head(outcomes[n:])
        tests = [*forms[:n], *(forms[n + i] - (forms[n + j] if j >= 0 else 0) for i, j in pairs)]
        shortfalls = self._shortfalls(
            cell, [form if right else -form for form, right in zip(tests, outcomes, strict=True)]
        )
        errors = self._output_errors(shortfalls[:n])
        if self.tree.labels is None:
            differences = forms[n:] - self.maps[cell.leaf]
            return max(self.bounds.size(form) + error for form, error in zip(differences, errors, strict=True))
        labels = head.labels(outcomes[None, n:])
        assert labels is not None
        if labels[0] != self.tree.labels[cell.leaf]:
            raise CertificateError(
                f"leaf {cell.leaf}: its label is {self.tree.labels[cell.leaf]}, the network's is {labels[0]} where the "
                f"tests are {cell.outcomes!r}"
            )
        of_pairs = [errors[i] + (errors[j] if j >= 0 else 0) for i, j in pairs]
        return max((e + error for e, error in zip(shortfalls[n:], of_pairs, strict=True)), default=0)

    def _forms(self, pattern: NDArray[np.bool_]) -> Numbers:
        """Return the affine forms of all units under an activation pattern: (n_units, d + 1)."""
        forms: Numbers = np.empty_like(self.own)
        gates: Numbers = np.array([1 if active else self.slope for active in pattern], dtype=self.own.dtype)
        for start, stop in pairwise(self.starts):
            forms[start:stop] = self.own[start:stop]
            if start:
                forms[start:stop] += (self.links[start:stop, :start] * gates[:start]) @ forms[:start]
        return forms

    def _pairs_of_head(self, outcomes: NDArray[np.bool_]) -> list[tuple[int, int]]:
        """Return, for each of the head's tests, the output asked about and the one subtracted, -1 for none."""
        head = self.network.head
        champions = head.champions(outcomes[None])[0].tolist()
        return [(head.first_challenger + test, champion) for test, champion in enumerate(champions)]

    def _shortfalls(self, cell: Cell, tests: list[Numbers]) -> list[Any]:
        """Return for each test, turned to its outcome, the bound e on how far it can be below 0 in the cell."""
        rows = self.sides | self._path_rows(cell.leaf) | {f"neuron {split}": tests[split] for split in cell.splits}
        shortfalls: list[Any] = [0] * len(tests)
        fixed = [test for test in range(len(tests)) if test not in cell.splits]
        for test, proof in zip(fixed, cell.proofs, strict=True):
            self._check_sum(cell.leaf, proof, rows)
            if not (self.exact and self._is_clear(tests[test], proof, rows)):
                remainder = tests[test] - self._sum(proof, rows)
                shortfalls[test] = max(0, -self.bounds.lowest(remainder))
        return shortfalls

    def _is_clear(self, test: Numbers, proof: Sum, rows: dict[str, Numbers]) -> bool:
        """Return whether float64 alone shows, its rounding reckoned with, that a remainder is nowhere below 0."""
        forms = np.array([test, *(rows[name] for name in proof.rows)]).astype(np.float64)
        weights = np.array([1.0, *(-multiplier for multiplier in proof.multipliers)])
        terms = weights[:, None] * forms
        lowest = self.rough_bounds.lowest(terms.sum(axis=0))
        return bool(lowest > _ROUNDING * self.rough_bounds.size(np.abs(terms).sum(axis=0)))

    def _output_errors(self, shortfalls: list[Any]) -> Numbers:
        """Return E of the outputs, given e of the hidden neurons."""
        of_units: Numbers = np.zeros(len(self.own), dtype=self.own.dtype)
        of_activations: Numbers = np.zeros(len(shortfalls), dtype=self.own.dtype)
        for start, stop in pairwise(self.starts):
            if start:
                of_units[start:stop] = self.size_of_links[start:stop, :start] @ of_activations[:start]
            for neuron in range(start, min(stop, len(shortfalls))):
                of_activations[neuron] = of_units[neuron] + (1 - self.slope) * shortfalls[neuron]
        return of_units[len(shortfalls) :]

    def _check_sum(self, leaf: int, terms: Sum, rows: dict[str, Numbers]) -> None:
        """Check that a sum is one of the region's rows, with multipliers that are not negative."""
        if len(terms.rows) != len(terms.multipliers):
            raise CertificateError(f"leaf {leaf}: {len(terms.rows)} rows and {len(terms.multipliers)} multipliers")
        for name, multiplier in zip(terms.rows, terms.multipliers, strict=True):
            if name not in rows:
                raise CertificateError(f"leaf {leaf}: the row {name!r} does not bound it")
            if not 0 <= multiplier <= _LARGEST_MULTIPLIER:
                raise CertificateError(
                    f"leaf {leaf}: the multiplier of {name!r} is {multiplier}, expected 0 to {_LARGEST_MULTIPLIER:g}"
                )

    def _sum(self, terms: Sum, rows: dict[str, Numbers]) -> Numbers:
        """Return a sum of rows as an affine form."""
        total: Numbers = np.zeros_like(self.own[0])
        for name, multiplier in zip(terms.rows, terms.multipliers, strict=True):
            total = total + (Fraction(multiplier) if self.exact else multiplier) * rows[name]
        return total

    def _check_empty(self, leaf: EmptyLeaf) -> None:
        """Check that a leaf's region holds no ball of a radius above the tolerance."""
        rows = self.sides | self._path_rows(leaf.leaf)
        self._check_sum(leaf.leaf, leaf.proof, rows)
        proof = _of_largest_one(leaf.proof)
        total = self._sum(proof, rows)
        lengths = [self.certificate.domain.length(np.asarray(rows[name], dtype=float)) for name in proof.rows]
        weight = sum(m * length for m, length in zip(proof.multipliers, lengths, strict=True))
        highest = float(self.bounds.highest(total))
        radius = highest / weight if 0 < weight < math.inf else math.inf
        # On a path to the right a test is above 0, so that a sum with it is, too.
        used = {name for name, multiplier in zip(proof.rows, proof.multipliers, strict=True) if multiplier > 0}
        is_strict = any(f"test {node}" in used for node in self._nodes_to_the_right(leaf.leaf))
        no_state = highest < 0 or (highest == 0 and is_strict)
        if not (no_state or radius <= self.certificate.tolerance * (1 + 1e-6) + 1e-12):
            raise CertificateError(
                f"leaf {leaf.leaf}: it is said to be empty, but nothing excludes a ball of radius {radius:.3g} in it"
            )

    def _path_rows(self, leaf: int) -> dict[str, Numbers]:
        nodes, signs = self._paths.nodes[leaf].tolist(), self._paths.signs[leaf].tolist()
        return {
            f"test {node}": self.tests[node] if sign > 0 else -self.tests[node]
            for node, sign in zip(nodes, signs, strict=True)
            if node >= 0
        }

    def _nodes_to_the_right(self, leaf: int) -> list[int]:
        return [int(node) for node in self._paths.nodes[leaf][self._paths.signs[leaf] > 0]]

    @cached_property
    def _paths(self) -> LeafPaths:
        return leaf_paths(self.tree)


def _of_largest_one(terms: Sum) -> Sum:
    """Return a sum scaled so that its largest multiplier is 1: it says the same, and its numbers do not overflow."""
    largest = max(terms.multipliers, default=0.0)
    if largest == 0:
        return terms
    return Sum(terms.rows, tuple(multiplier / largest for multiplier in terms.multipliers))


class _Bounds:
    """Bounds of affine forms over a domain; where it is open, in units of 1 + the sum of |x_i| over the open inputs."""

    def __init__(self, domain: Domain, exact: bool) -> None:
        self.is_closed = np.isfinite(domain.low) & np.isfinite(domain.high)
        low, high = np.where(self.is_closed, domain.low, 0.0), np.where(self.is_closed, domain.high, 0.0)
        self.low, self.high = (_fractions(low), _fractions(high)) if exact else (low, high)

    def lowest(self, form: Numbers) -> Any:
        """Return a bound on the lowest value."""
        return -self.highest(-form)

    def highest(self, form: Numbers) -> Any:
        """Return a bound on the highest value."""
        f, f0 = form[:-1], form[-1]
        highest = f0 + np.where(f > 0, f * self.high, f * self.low).sum()
        open_slopes = np.abs(f[~self.is_closed])
        if not open_slopes.any():
            return highest
        return max(highest, open_slopes.max())

    def size(self, form: Numbers) -> Any:
        """Return the largest absolute value."""
        return max(self.highest(form), self.highest(-form), 0)


def _fractions(values: NDArray[np.float64]) -> Numbers:
    exact = np.empty(values.shape, dtype=object)
    exact.ravel()[:] = [Fraction(value) for value in values.ravel().tolist()]
    return exact


def _rounded_up(value: Any) -> float:
    """Return the smallest float64 that is not below a number."""
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)
