"""Certificates checked, without a solver, in exact arithmetic.

Let A be the pattern that a cell of a certificate claims, and z_j^A(x) the pre-activation of neuron j if the neurons
before it behave as in A: an affine function. The proof of neuron j shows ``s_j z_j^A(x) >= -e_j`` in the cell, where
s_j is its sign in A and e_j >= 0 the bound of the remainder. By induction over the neurons,

    |z_j(x) - z_j^A(x)| <= E_j := sum_k |w_jk| D_k,      |a_k(x) - a_k^A(x)| <= D_k := E_k + (1 - negative_slope) e_k,

with w_jk the weight from neuron k to unit j, as the activation is 1-Lipschitz and its two pieces differ by no more
than ``(1 - negative_slope) |z|``. For an output the same sum bounds its distance from the affine map of A, and the
leaf's map is compared with that map. Of labels what is compared are the affine maps of two outputs: the network can
have another label than the leaf only where their difference is no larger than a bound, which is reckoned as a distance
from where it is 0 (`TreeAndNetwork.beyond_boundary`). A test that splits the leaf's region needs no proof: the cells on
both its sides are there, which are told apart by the sign of z_j^A itself, and a cell may be left out only with a sum
of its rows that cannot be what it would have to be at a point of the cell. So every real point of the domain is in a
proved cell.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np

from otr.core.clock import check_time, time_limit
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.errors import CertificateError
from otr.geometry.rational import Basis, Integers, common_integers, integers
from otr.proof.certificate import Cell, Certificate, Sum
from otr.proof.exact_rows import INFINITE, ExactRow, TreeAndNetwork, is_wide

_NEGLIGIBLE = Fraction(1, 10**9)  # a difference of outputs that is not worth the sharpest bound
_BELOW_ZERO = Fraction(-1, 10**30)


def verify(
    certificate: Certificate, tree: ObliqueTree, network: ReluNetwork, *, max_seconds: float | None = None
) -> float:
    """Check that a certificate proves that `tree` computes the same function as `network`, and return the bound.

    Args:
        certificate: of this tree and this network.
        tree: the tree.
        network: the network.
        max_seconds: refuse to check for longer.

    Returns:
        The bound on the difference, as `Certificate.max_error` is defined; not above it.

    Raises:
        CertificateError: something is not proved; the message names the leaf, and a point where tree and network differ
            if one is found.
        TimeLimitError: the limit was met.
    """
    given = (certificate, tree, network)
    if not all(map(isinstance, given, (Certificate, ObliqueTree, ReluNetwork))):
        names = ", ".join(type(each).__name__ for each in given)
        raise TypeError(f"verify takes a Certificate, an ObliqueTree and a ReluNetwork, got {names}")
    _check_fit(certificate, tree, network)
    checker = Checker(TreeAndNetwork(tree, network, certificate.domain, in_box=_is_in_box(certificate, tree, network)))
    with time_limit(max_seconds, checker.reached):
        try:
            return checker.run(certificate)
        except CertificateError as error:
            from otr.proof.exact_cells import refusal  # the solver; what is refused is refused without it

            raise refusal(error, checker.pair, certificate.max_error) from error


def _is_in_box(certificate: Certificate, tree: ObliqueTree, network: ReluNetwork) -> bool:
    """Return whether the sides of a box of many inputs may be no rows: no proof names one."""
    domain = certificate.domain
    if not is_wide(tree, network, domain):
        return False
    sides = set(domain.sides()[1]) - set(domain.sides(in_box=True)[1])
    sums = (each for cell in certificate.cells for each in (*cell.proofs, *cell.bounds, cell.empty) if each is not None)
    return not any(sides.intersection(each.rows) for each in sums)


def _check_fit(certificate: Certificate, tree: ObliqueTree, network: ReluNetwork) -> None:
    domain = certificate.domain
    shapes = {(tree.n_inputs, tree.n_outputs), (network.n_inputs, network.n_outputs)}
    if shapes != {(domain.n_inputs, tree.n_outputs)} or tree.head != network.head:
        raise CertificateError(
            f"the tree has {tree.n_inputs} inputs, {tree.n_outputs} outputs and the head {tree.head!r}, the "
            f"network {network.n_inputs}, {network.n_outputs} and {network.head!r}, the domain {domain.n_inputs} "
            "inputs"
        )
    if not 0 <= certificate.max_error < math.inf:
        raise CertificateError(f"leaf 0: the certificate claims {certificate.max_error}, expected a finite error")
    if tree.n_leaves != certificate.n_leaves:
        leaf = min(tree.n_leaves, certificate.n_leaves)
        raise CertificateError(
            f"leaf {leaf}: the tree has {tree.n_leaves} leaves, the certificate is of one with {certificate.n_leaves}",
            leaf,
        )


class Checker:
    """Checks cells of a pair."""

    def __init__(self, pair: TreeAndNetwork) -> None:
        """Keep the pair."""
        self.pair = pair
        self.bounds = Bounds(pair.domain, pair.power, pair.basis)
        self.n_checked = 0  # leaves

    def reached(self) -> str:
        """Return how far the check came, in words."""
        return f"{self.n_checked:,} of {self.pair.tree.n_leaves:,} leaves were checked"

    def run(self, certificate: Certificate) -> float:
        """Check everything and return the bound on the difference."""
        by_leaf: dict[int, list[Cell]] = {}
        for cell in certificate.cells:
            self._check_form(cell)
            by_leaf.setdefault(cell.leaf, []).append(cell)
        worst = Fraction(0)
        for leaf in range(self.pair.tree.n_leaves):
            if leaf not in by_leaf:
                raise CertificateError(f"leaf {leaf}: the certificate does not cover it", leaf)
            check_cover(leaf, by_leaf[leaf])
            for cell in by_leaf[leaf]:
                check_time()
                error = self.error(cell)
                if error > Fraction(certificate.max_error):
                    raise CertificateError(
                        f"leaf {leaf}: tree and network may differ by {rounded_up(error):.3g} where the neurons are "
                        f"{cell.outcomes!r}; the certificate claims {certificate.max_error:.3g}",
                        leaf,
                    )
                worst = max(worst, error)
            self.n_checked += 1
        return rounded_up(worst)

    def error(self, cell: Cell) -> Fraction:
        """Return the bound on the difference in a cell, 0 in an empty one; raise CertificateError if none is shown."""
        outcomes, n = [outcome == "1" for outcome in cell.outcomes], self.pair.network.n_hidden
        padded = outcomes + [False] * (self.pair.n_tests - len(outcomes))
        forms = self.pair.forms(padded[:n])
        tests = [*forms[:n], *self.pair.head_tests(forms, padded)]
        turned = [test if outcome else -test for test, outcome in zip(tests, outcomes, strict=False)]
        rows = self.pair.rows_of_leaf(cell.leaf)
        rows |= {f"neuron {split}": ExactRow(turned[split], outcomes[split]) for split in cell.splits}
        if cell.empty is not None:
            self._check_empty(cell, cell.empty, rows)
            return Fraction(0)
        shortfalls = [Fraction(0)] * len(tests)
        is_strict = list(outcomes)  # whether every state is beyond a test's shortfall, not just at it
        fixed = [test for test in range(len(tests)) if test not in cell.splits]
        for test, proof in zip(fixed, cell.proofs, strict=True):
            total, scale = self._total(cell.leaf, proof, rows)
            shortfalls[test] = self.bounds.highest(total - turned[test] * scale) / scale
            is_strict[test] = _has_strict_row(proof, rows)
        differences = self.pair.differences(cell.leaf, forms, outcomes)
        bounds = [self._bound(cell, at, form, rows) for at, form in enumerate(differences)]
        errors = self._output_errors([_few_digits(shortfall) for shortfall in shortfalls[:n]])
        if self.pair.tree.labels is None:
            return max(bound + error for bound, error in zip(bounds, errors, strict=True))
        of_tests = list(zip(outcomes[n:], shortfalls[n:], is_strict[n:], strict=True))
        return self._label_error(cell.leaf, forms, of_tests, bounds, errors)

    def _label_error(
        self,
        leaf: int,
        forms: Integers,
        of_tests: list[tuple[bool, Fraction, bool]],
        bounds: list[Fraction],
        errors: list[Fraction],
    ) -> Fraction:
        """Return how far beyond the boundary of its label the states of a cell can be.

        `of_tests` are, of every challenge to the champion so far, whether it is won, the shortfall of that, and whether
        it is won or lost by more than this.
        """
        # How far the score of each label can be above the champion's, and whether it stays below that
        above, is_below = [Fraction(0)], [False]
        for is_won, shortfall, is_strict in of_tests:
            if is_won:
                above = [value + shortfall for value in above]
                is_below = [value or is_strict for value in is_below]
            above.append(Fraction(0) if is_won else shortfall)
            is_below.append(not is_won and is_strict)
        assert self.pair.tree.labels is not None
        label, scores = int(self.pair.tree.labels[leaf]), self.pair.scores(forms)
        errors = [*[Fraction(0)] * (len(scores) - len(errors)), *errors]
        beyond = [Fraction(0)]
        for other in range(len(scores)):
            form, error = scores[other] - scores[label], errors[other] + errors[label]
            if other == label or self._is_below_zero(form, error):
                continue
            highest = above[other] + sum(bounds, Fraction(0)) + error
            is_reached = other < label and not is_below[other]
            beyond.append(self.pair.beyond_boundary(form, highest, is_reached=is_reached))
        return max(beyond)

    def _is_below_zero(self, form: Integers, error: Fraction) -> bool:
        """Return whether a form that is off by no more than an error is below 0 throughout the domain.

        An error is in units of 1 + the size of the open inputs, so that there it would have to be 0.
        """
        return self.bounds.highest(form) + error < 0 and (not error or bool(self.bounds.is_closed.all()))

    def _bound(self, cell: Cell, at: int, form: Integers, rows: dict[str, ExactRow]) -> Fraction:
        """Return the bound on the absolute value of difference number `at` in a cell."""
        highest = []
        for side, signed in enumerate((form, -form)):
            proof = cell.bounds[2 * at + side] if len(cell.bounds) > 2 * at + side else Sum((), ())
            total, scale = self._total(cell.leaf, proof, rows)
            highest.append(self.bounds.highest(total + signed * scale, enough=_NEGLIGIBLE * scale) / scale)
        return max(*highest, Fraction(0))

    def _output_errors(self, shortfalls: Sequence[Fraction]) -> list[Fraction]:
        """Return E of the outputs, given e of the hidden neurons."""
        network = self.pair.network
        if not any(shortfalls):
            return [Fraction(0)] * network.n_outputs
        units, n, active = network.unit_form(), len(shortfalls), Fraction(1) - Fraction(network.negative_slope)
        of_units, of_activations = [Fraction(0)] * len(units.inputs), [Fraction(0)] * n
        for start, stop in pairwise((*units.layer_starts, len(units.inputs))):
            for unit in range(start, stop):
                links = np.abs(units.links[unit, :start])
                of_units[unit] = sum(
                    (Fraction(link) * of_activations[k] for k, link in enumerate(links.tolist()) if link), Fraction(0)
                )
            for neuron in range(start, min(stop, n)):
                of_activations[neuron] = of_units[neuron] + active * shortfalls[neuron]
        return of_units[n:]

    def _total(self, leaf: int, terms: Sum, rows: dict[str, ExactRow]) -> tuple[Integers, int]:
        """Return a sum of rows, times the number that comes with it, and that number."""
        if len(terms.rows) != len(terms.multipliers):
            raise CertificateError(
                f"leaf {leaf}: {len(terms.rows)} rows and {len(terms.multipliers)} multipliers", leaf
            )
        for name, multiplier in zip(terms.rows, terms.multipliers, strict=True):
            if name not in rows:
                raise CertificateError(f"leaf {leaf}: the row {name!r} does not bound it", leaf)
            if not 0 <= multiplier < math.inf:
                raise CertificateError(
                    f"leaf {leaf}: the multiplier of {name!r} is {multiplier}, expected a number of at least 0", leaf
                )
        ratios = [multiplier.as_integer_ratio() for multiplier in terms.multipliers]
        scale = math.lcm(*(denominator for _, denominator in ratios))
        total = np.array([0] * (self.pair.n_coordinates + 1), dtype=object)
        for name, (numerator, denominator) in zip(terms.rows, ratios, strict=True):
            total += rows[name].numbers * (numerator * (scale // denominator))
        return total, scale

    def _check_empty(self, cell: Cell, proof: Sum, rows: dict[str, ExactRow]) -> None:
        """Check that at no point all rows of a cell hold."""
        total, _ = self._total(cell.leaf, proof, rows)
        highest = self.bounds.highest(total, is_relative=False)
        if not (highest < 0 or (highest == 0 and _has_strict_row(proof, rows))):
            raise CertificateError(
                f"leaf {cell.leaf}: the cell {cell.outcomes!r} is said to be empty, but its rows do not exclude that "
                "a state is in it",
                cell.leaf,
            )

    def _check_form(self, cell: Cell) -> None:
        n_tests, n_outcomes = self.pair.n_tests, len(cell.outcomes)
        well_formed = (
            0 <= cell.leaf < self.pair.tree.n_leaves
            and set(cell.outcomes) <= {"0", "1"}
            and list(cell.splits) == sorted(set(cell.splits))
            and all(0 <= split < n_outcomes for split in cell.splits)
        )
        if cell.empty is None:
            well_formed = well_formed and n_outcomes == n_tests and len(cell.proofs) == n_tests - len(cell.splits)
        else:
            well_formed = well_formed and n_outcomes <= n_tests
        if not well_formed:
            raise CertificateError(
                f"leaf {cell.leaf}: the cell {cell.outcomes!r} is not one of this network's", cell.leaf
            )


def check_cover(leaf: int, cells: Sequence[Cell], after: int = 0) -> None:
    """Raise CertificateError unless cells are all of a leaf's region: both sides of every test that splits it."""
    firsts = {next((split for split in cell.splits if split >= after), None) for cell in cells}
    if firsts == {None} and len(cells) == 1:
        return
    if len(firsts) != 1 or None in firsts:
        raise CertificateError(f"leaf {leaf}: its cells do not cover it; the tests that split it disagree", leaf)
    (test,) = firsts
    assert test is not None
    shared = {cell.outcomes[after:test] for cell in cells}
    sides = [[cell for cell in cells if cell.outcomes[test] == outcome] for outcome in "01"]
    if len(shared) != 1 or not all(sides):
        raise CertificateError(f"leaf {leaf}: its cells do not cover it; one side of test {test} is missing", leaf)
    for side in sides:
        check_cover(leaf, side, test + 1)


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


def _has_strict_row(terms: Sum, rows: dict[str, ExactRow]) -> bool:
    """Return whether a sum is above 0, not just at it, where its rows hold."""
    return any(rows[name].is_strict for name, weight in zip(terms.rows, terms.multipliers, strict=True) if weight > 0)


def _few_digits(value: Fraction) -> Fraction:
    """Return a number that is not below another and quick to compute with, or 0 where that is below it."""
    if value <= 0:
        return Fraction(0)
    above = rounded_up(value)
    return Fraction(above) if above < math.inf else value


def rounded_up(value: Fraction) -> float:
    """Return the smallest float64 that is not below a number; infinite where all are."""
    try:
        nearest = float(value)
    except OverflowError:
        return math.inf if value > 0 else -sys.float_info.max
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)
