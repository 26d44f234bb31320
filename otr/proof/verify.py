"""Certificates checked, without a solver, in exact arithmetic.

Let A be the pattern that a cell of a certificate claims, and z_j^A(x) the pre-activation of neuron j if the neurons
before it behave as in A: an affine function. The proof of neuron j shows ``s_j z_j^A(x) >= -e_j`` in the cell, where
s_j is its sign in A and e_j >= 0 the bound of the remainder. By induction over the neurons,

    -E_j^- <= z_j(x) - z_j^A(x) <= E_j^+,      -E_k^- <= a_k(x) - a_k^A(x) <= E_k^+ + (1 - negative_slope) e_k,

where E_j sums what the activations before can add or take away, times the weights: the activation is 1-Lipschitz and
never falls, and is above the wrong one of its two pieces by no more than ``(1 - negative_slope) |z|``. For an output
the same sum bounds its distance from the affine map of A, and the leaf's map is compared with that map.

Labels are compared by distances between states. Let Q be the piece of the network, with its sides, where its tests
have the outcomes A, and the network the leaf's label. The proofs show ``r_i(x) >= -m_i u(x)`` in the cell for every
test r_i of A and every side of the domain, with u = 1 or, where the domain is open, 1 + the sum of |x_i|. With (p, s)
such that ``r_i(p, s) := a_i . p + b_i s >= m_i`` for all of them, which is a point p / s of Q or a direction in it,

    y = (x + u p) / (1 + u s)    has    r_i(y) (1 + u s) = r_i(x) + u r_i(p, s) >= 0,

so y is in Q and in the domain, and ``|y - x| <= u |p - s x|``. Sides that are no rows need no proof where p is s times
a state within them: then y is between x and that. Of the tests, the last that is won decides whether the network has
the label on the sides of Q, too, where it may tie.

Where outputs tie throughout Q, so that the network has the label nowhere in it, y is to be on the boundary of a test of
Q, and a change of one input brings the states there: what may be wrong is a sliver.

A test that splits the leaf's region needs no proof: the cells on both its sides are there, which are distinguished by
the sign of z_j^A itself, and a cell may be left out only with a sum of its rows that cannot be what it would have to be
at a point of the cell. So every real point of the domain is in a proved cell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import singledispatch
from typing import Any

import numpy as np

from otr.clock import check_time, time_limit
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.errors import CertificateError
from otr.geometry.rational import Integers, without_denominators
from otr.proof.certificate import Cell, Certificate, Sum, check_cover
from otr.proof.exact_rows import INFINITE, ON_BOUNDARY, Bounds, ExactRow, TreeAndNetwork, is_wide, rounded_up

NEGLIGIBLE = Fraction(1, 10**9)  # a difference of outputs that is not worth the sharpest bound


@singledispatch
def verify(certificate: Any, tree: Any, network: Any, *, max_seconds: float | None = None) -> float:
    """Check that a certificate proves that `tree` computes the same function as `network`, and return the bound.

    Args:
        certificate: of this tree and this network.
        tree, network: what it is of.
        max_seconds: refuse to check for longer.

    Returns:
        The bound on the difference, as `Certificate.max_error` is defined; not above it.

    Raises:
        CertificateError: something is not proved; the message names the leaf, and a point that shows it, if found.
        TimeLimitError: the limit was met.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> tree = otr.map_network(net)
        >>> otr.verify(otr.certify(tree, net), tree, net)
        0.0
    """
    given = (certificate, tree, network)
    if not all(map(isinstance, given, (Certificate, ObliqueTree, ReluNetwork))):
        names = ", ".join(type(each).__name__ for each in given)
        raise TypeError(f"verify takes a Certificate, an ObliqueTree and a ReluNetwork, got {names}")
    check_fit(certificate, tree, network)
    checker = Checker(TreeAndNetwork(tree, network, certificate.domain, in_box=_is_in_box(certificate, tree, network)))
    with time_limit(max_seconds, checker.reached):
        try:
            return checker.run(certificate)
        except CertificateError as error:
            from otr.proof.exact_cells import refusal  # the solver; what is refused is refused without it

            raise refusal(error, checker.pair, certificate.max_error) from error


def _is_in_box(certificate: Certificate, tree: ObliqueTree, network: ReluNetwork) -> bool:
    """Return whether the sides of a box of many inputs may be no rows: no proof names one or is about one."""
    domain, has_labels = certificate.domain, tree.labels is not None
    if not is_wide(tree, network, domain):
        return False
    of_rows = domain.sides(in_box=True)[1]
    if has_labels and any(cell.thin or len(cell.bounds) > len(of_rows) for cell in certificate.cells):
        return False
    sides = set(domain.sides()[1]) - set(of_rows)
    sums = (each for cell in certificate.cells for each in (*cell.proofs, *cell.bounds, cell.empty) if each is not None)
    return not any(sides.intersection(each.rows) for each in sums)


def check_fit(certificate: Certificate, tree: ObliqueTree, network: ReluNetwork) -> None:
    """Raise CertificateError unless a certificate is of a tree and a network of these sizes, and of a finite error."""
    domain = certificate.domain
    shapes = {(tree.n_inputs, tree.n_outputs), (network.n_inputs, network.n_outputs)}
    if shapes != {(domain.n_inputs, tree.n_outputs)} or tree.head != network.head:
        raise CertificateError(
            f"the tree has {tree.n_inputs} inputs, {tree.n_outputs} outputs and the head {tree.head!r}, the "
            f"network {network.n_inputs}, {network.n_outputs} and {network.head!r}, the domain {domain.n_inputs} inputs"
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
        limits = [pair.domain.low, pair.domain.high]
        self._limits, self._unit = without_denominators(np.where(self.bounds.is_closed, limits, 0.0).ravel().tolist())
        self._widths = list(map(float, pair.widths()))
        self.n_checked = 0  # leaves

    def reached(self) -> str:
        """Return the progress of the check, as text."""
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
        pair, outcomes = self.pair, bits(cell.outcomes)
        n, turned = pair.network.n_hidden, pair.turned(outcomes)
        rows = rows_of(pair, cell, turned)
        if cell.empty is not None:
            self._check_empty(cell, cell.empty, rows)
            return Fraction(0)
        if pair.tree.labels is not None:
            return self._distance(cell, rows, turned)
        shortfalls = [Fraction(0)] * len(turned)
        for test, proof in zip(proved_tests(cell), cell.proofs, strict=True):
            shortfalls[test] = self.shortfall(cell.leaf, turned[test], proof, rows)
        differences = pair.differences(cell.leaf, pair.forms(outcomes[:n]), outcomes)
        signed = [form for difference in differences for form in (difference, -difference)]
        errors = self._output_errors([_few_digits(shortfall) for shortfall in shortfalls[:n]])
        bounds = [self._bound(cell, at, form, rows) for at, form in enumerate(signed)]
        return max(Fraction(0), *(bound + error for bound, error in zip(bounds, errors, strict=True)))

    def _distance(self, cell: Cell, rows: dict[str, ExactRow], turned: list[Integers]) -> Fraction:
        """Return how far states of a cell are, at most, from the nearest at which the network has the leaf's label.

        `turned` are the network's tests in the directions of the cell's outcomes.
        """
        pair, near = self.pair, cell.near or cell.outcomes
        n, of_near = pair.network.n_hidden, bits(near)
        assert pair.tree.labels is not None
        if pair.label(of_near) != pair.tree.labels[cell.leaf]:
            return INFINITE
        forms = [*(pair.turned(of_near) if cell.near else turned), *(side.numbers for side in pair.sides.values())]
        if cell.thin:
            return self._sliver(cell, rows, forms)
        least, is_above = self.least(cell, forms, rows)
        last = near.rfind("1", n)  # the test whose winner has the label; if none is won, ties have it, too
        if max(least, default=0) <= 0 and (last < 0 or is_above[last]):
            return Fraction(0)
        return self._way(cell.towards, forms, least, last)

    def least(self, cell: Cell, forms: list[Integers], rows: dict[str, ExactRow]) -> tuple[list[Fraction], list[bool]]:
        """Return how far below 0 forms are in a cell, at most, and of which a proof shows that they are above.

        Of the tests it is at least 0; of the sides of a bounded domain, how far all states are within, times -1.
        """
        least = [Fraction(0)] * len(forms)
        is_above = [outcome == "1" for outcome in (cell.near or cell.outcomes)]
        for at, proof in _proofs(cell, self.pair.n_tests):
            shortfall = self.shortfall(cell.leaf, forms[at], proof, rows)
            if at < self.pair.n_tests:
                least[at], is_above[at] = _few_digits(shortfall), shortfall < 0 or _has_strict_row(proof, rows)
            elif self.bounds.is_closed.all():
                least[at] = Fraction(min(0.0, rounded_up(shortfall)))
        return least, is_above

    def _way(
        self, towards: Sequence[float | Fraction], forms: list[Integers], least: list[Fraction], last: int
    ) -> Fraction:
        """Return how far states come that go `towards` where no form is below 0, and the last test won is above it.

        The forms are those of the tests, then of the domain's sides; the states' own values are not below -least.
        """
        if not towards:
            return INFINITE
        way, denominator = without_denominators(towards)
        values = self.pair.along(forms, way, denominator)
        if any(value <= 0 < m for value, m in zip(values, least, strict=True)):
            return INFINITE
        times = max((m / value for value, m in zip(values, least, strict=True) if m > 0), default=Fraction(0))
        ends = [times * value - m for value, m in zip(values, least, strict=True)]
        may_go_on = all(value >= 0 or end > 0 for value, end in zip(values, ends, strict=True))
        if min(ends) < 0 or not (last < 0 or ends[last] > 0 or (values[last] > 0 and may_go_on)):
            return INFINITE
        slack = dict(zip(self.pair.sides, least[self.pair.n_tests :], strict=True))
        farthest = self._farthest(way, denominator, slack)
        return INFINITE if farthest == INFINITE else max(times * farthest, ON_BOUNDARY)

    def _farthest(self, way: Integers, denominator: int, slack: dict[str, Fraction]) -> Fraction:
        """Return how far p is from s x, at most, at states x of the domain, in widths of inputs, of a way (p, s).

        By side that is a row, all states are within by the slack, times -1. Of sides that are no rows it is infinite
        unless p is s times a state within them, so that what is between that and x is within, too.
        """
        limits, unit = self._limits, self._unit
        if any(slack.values()):
            inwards = [
                sign * slack[f"{end} {i}"] for end, sign in (("low", -1), ("high", 1)) for i in range(len(way) - 1)
            ]
            limits, unit = without_denominators(
                [Fraction(int(limit), unit) + step for limit, step in zip(limits, inwards, strict=True)]
            )
        (low, high), p, s = np.split(limits, 2), way[:-1], way[-1]
        from_low, to_high, is_closed = p * unit - s * low, s * high - p * unit, self.bounds.is_closed
        if self.pair.in_box and (np.minimum(from_low, to_high)[is_closed] < 0).any():
            return INFINITE
        changes = np.where(is_closed, np.maximum(abs(from_low), abs(to_high)), np.maximum(abs(p), s) * unit)
        farthest: dict[float, int] = {}
        for change, width in zip(changes.tolist(), self._widths, strict=True):
            farthest[width] = max(farthest.get(width, 0), change)
        if farthest.pop(0.0, 0):
            return INFINITE  # of an input that is constant
        return max((change / Fraction(width) for width, change in farthest.items()), default=Fraction(0)) / (
            unit * denominator
        )

    def _sliver(self, cell: Cell, rows: dict[str, ExactRow], forms: list[Integers]) -> Fraction:
        """Return how far a cell's states are, at most, from where test `onto` is 0 and no form is below 0.

        They go along the first input that `towards` names.
        """
        row = forms[cell.onto]
        widths = self.pair.widths()
        axis = next((i for i, number in enumerate(cell.towards[:-1]) if number and row[i] and widths[i]), -1)
        if axis < 0:
            return INFINITE
        proofs = dict(_proofs(cell, self.pair.n_tests))
        for at, form in enumerate(forms):
            if self.shortfall(cell.leaf, brought_to(row, axis, form), proofs.get(at, Sum((), ())), rows) > 0:
                return INFINITE
        farthest = max(
            self.shortfall(cell.leaf, form, proof, rows) for form, proof in zip((row, -row), cell.thin, strict=True)
        )
        width = widths[axis] * abs(int(row[axis]))
        return max(Fraction(farthest * 2**self.pair.power, width), ON_BOUNDARY)

    def shortfall(self, leaf: int, form: Integers, proof: Sum, rows: dict[str, ExactRow]) -> Fraction:
        """Return how far below 0, at most, a form is where rows hold, given the sum of them that it is to be."""
        total, scale = self._total(leaf, proof, rows)
        return self.bounds.highest(total - form * scale) / scale

    def _bound(self, cell: Cell, at: int, form: Integers, rows: dict[str, ExactRow]) -> Fraction:
        """Return the bound on difference number `at` // 2, or on its negative if that is odd, in a cell."""
        proof = cell.bounds[at] if len(cell.bounds) > at else Sum((), ())
        total, scale = self._total(cell.leaf, proof, rows)
        return self.bounds.highest(total + form * scale, enough=NEGLIGIBLE * scale) / scale

    def _output_errors(self, shortfalls: Sequence[Fraction]) -> list[Fraction]:
        """Return E+ and E- of each output, (2 o,), given e of the hidden neurons."""
        network = self.pair.network
        if not any(shortfalls):
            return [Fraction(0)] * (2 * network.n_outputs)
        units, n, active = network.unit_form(), len(shortfalls), Fraction(1) - Fraction(network.negative_slope)
        errors: list[tuple[Fraction, Fraction]] = []  # of activations and outputs, upwards and downwards
        for unit, links in enumerate(units.links.tolist()):
            up = down = Fraction(0)
            for link, (upwards, downwards) in zip(links, errors, strict=False):
                if link and (upwards or downwards):
                    weight = Fraction(link)
                    up += weight * upwards if link > 0 else -weight * downwards
                    down += weight * downwards if link > 0 else -weight * upwards
            errors.append((up + active * shortfalls[unit] if unit < n else up, down))
        return [error for of_output in errors[n:] for error in of_output]

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
            and set(cell.outcomes + cell.near) <= {"0", "1"}
            and list(cell.splits) == sorted(set(cell.splits))
            and all(0 <= split < n_outcomes for split in cell.splits)
            and len(cell.near) in (0, n_tests)
            and len(cell.towards) in (0, self.pair.domain.n_inputs + 1)
            and all(-math.inf < number < math.inf for number in cell.towards)
            and (not cell.towards or cell.towards[-1] >= 0)
            and len(cell.thin) in (0, 2)
            and 0 <= cell.onto < max(n_tests, 1)
            and (self.pair.tree.labels is None or len(cell.bounds) in (0, len(self.pair.sides)))
        )
        if cell.empty is None:
            well_formed = well_formed and n_outcomes == n_tests and len(cell.proofs) == len(list(proved_tests(cell)))
        else:
            well_formed = well_formed and n_outcomes <= n_tests
        if not well_formed:
            raise CertificateError(
                f"leaf {cell.leaf}: the cell {cell.outcomes!r} is not one of this network's", cell.leaf
            )


def rows_of(pair: TreeAndNetwork, cell: Cell, turned: Sequence[Integers]) -> dict[str, ExactRow]:
    """Return the rows of a cell: its leaf's, and the tests that split that, `turned` in the cell's direction."""
    splits = {f"neuron {split}": ExactRow(turned[split], cell.outcomes[split] == "1") for split in cell.splits}
    return pair.rows_of_leaf(cell.leaf) | splits


def brought_to(row: Integers, axis: int, form: Integers) -> Integers:
    """Return a form, times the size of a row's slope, as it is where an input has been changed until the row is 0."""
    return np.asarray((form * row[axis] - row * form[axis]) * (1 if row[axis] > 0 else -1))


def bits(outcomes: str) -> list[bool]:
    """Return outcomes as truth values."""
    return [outcome == "1" for outcome in outcomes]


def proved_tests(cell: Cell) -> list[int]:
    """Return the tests that have a proof."""
    return [test for test in range(len(cell.outcomes)) if cell.near or test not in cell.splits]


def _proofs(cell: Cell, n_tests: int) -> list[tuple[int, Sum]]:
    """Return the sums of a cell with labels: by test, and by n_tests + the number of a side of the domain."""
    return [*zip(proved_tests(cell), cell.proofs, strict=True), *enumerate(cell.bounds, n_tests)]


def _has_strict_row(terms: Sum, rows: dict[str, ExactRow]) -> bool:
    """Return whether a sum is above 0, not just at it, where its rows hold."""
    return any(rows[name].is_strict for name, weight in zip(terms.rows, terms.multipliers, strict=True) if weight > 0)


def _few_digits(value: Fraction) -> Fraction:
    """Return a number that is not below another and quick to compute with, or 0 where that is below it."""
    if value <= 0:
        return Fraction(0)
    above = rounded_up(value)
    return Fraction(above) if above < math.inf else value
