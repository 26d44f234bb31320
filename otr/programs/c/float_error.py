"""What single or double precision changes of the answers of a policy in C: a running error analysis over a box.

Each operation is taken to round to nearest, or to be fused with the next one, and a number too small for the type may
be flushed to zero; so |computed - exact| <= u |exact| + tiny, with u half the distance from 1 to the next number. The
operations are those that `to_c` prints, in their order. The bounds are computed in float64 and rounded up.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree, require_tree
from otr.geometry.jumps import highest, jumps, paths_sum, reach
from otr.programs.c.tables import CType, literal, row_layout
from otr.programs.merging import merge_equal_leaves
from otr.programs.walk import distinct_rows

_UP = 1 + 2.0**-30  # more than the rounding of the sums of bounds here, all of which are positive
_LIBRARY = 8  # u, as a share of 1: the error of tanh and exp of a mathematical library
_OF_TREE = 16  # times what double precision may err by, is how far equal tests of a tree in float64 may be apart
_JUMP = 100  # times the rounding of leaves: what the sides of a test may differ by on its boundary


@dataclass(frozen=True)
class FloatErrorBound:
    """What the C code of a tree changes of its answers, at every state of a box whose numbers are of the type.

    Attributes:
        max_error: of any action, in its units; of labels 0.
        errors: (n_answers,) the same for each action; of labels none.
        margin: of a head that chooses among outputs: its label is the same where it leads by more than this.
        distance: the bounds hold farther than this (Euclidean, in the inputs) from the tests where the tree jumps, of
            which there are `n_jumps`; 0 if it is continuous: then they hold everywhere.
        dtype, box: "double" or "float", and the states.
    """

    max_error: float
    errors: FloatArray
    margin: float
    distance: float
    n_jumps: int
    dtype: CType
    box: Domain

    def __str__(self) -> str:
        what = f"no action changes by more than {self.max_error:.2g}" if len(self.errors) else "no label changes"
        where = [f"where the largest output leads by more than {self.margin:.2g}"] if self.margin else []
        if self.n_jumps:
            tests = "1 test" if self.n_jumps == 1 else f"{self.n_jumps:,} tests"
            where.append(f"farther than {self.distance:.2g} from {tests} at which the tree jumps")
        return " ".join([f"by rounding to {self.dtype}, {what}", " and ".join(where)]).strip()


def float_error(tree: ObliqueTree, box: Box | Domain, dtype: CType = "float") -> FloatErrorBound:
    """Return a bound on what rounding changes of a tree's answers in the code of ``otr.to_c(tree, dtype=dtype)``.

    Coefficients are rounded to the type, then every product and every sum. A state near a test may be sent to the other
    side; where the tree is continuous, as one that is mapped from a network is, that changes the outputs by the
    difference of the sides' slopes times the distance. A tree that jumps at a test answers the same, up to the bound,
    except within a distance of it. tanh and exp of the library are taken to err by less than 8 u.

    Args:
        tree: any but one with the head PidBox, which multiplies outputs; the numbers of a basis are those of P and M.
        box: bounded.
        dtype: "float" or "double".

    Raises:
        ValueError: the box is open, the head multiplies outputs, or a number over the box overflows the type.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> found = otr.float_error(otr.map_network(net), ([-1], [1]))
        >>> found.n_jumps, 0 <= found.max_error < 1e-6
        (0, True)
    """
    require_tree(tree)
    domain = as_domain(box, tree.n_inputs)
    if not domain.is_bounded:
        raise ValueError("the box has open sides, over which rounding errors have no bound")
    if isinstance(tree.head, PidBox):
        raise ValueError(f"the head {tree.head!r} multiplies outputs, of which there is no bound here")
    if dtype not in ("double", "float"):
        raise ValueError(f"dtype is {dtype!r}, expected 'double' or 'float'")
    tree = merge_equal_leaves(tree)
    rounding = _Rounding(domain, dtype)
    within = rounding.of_rows(tree.test_forms)
    if dtype == "double":
        within = _OF_TREE * within
    if tree.labels is not None:
        found = jumps(tree, domain, within, 0.0)
        return FloatErrorBound(0.0, np.zeros(0), 0.0, found.distance, found.n_jumps, dtype, domain)
    forms = tree.leaf_forms.reshape(-1, tree.n_inputs + 1)
    leaves = rounding.of_rows(forms).reshape(tree.n_leaves, -1)
    found = jumps(tree, domain, within, _JUMP * float(leaves.max()))
    errors = (leaves + paths_sum(tree, found.changes)).max(axis=0) * _UP
    if tree.head.gives_labels:
        return FloatErrorBound(0.0, np.zeros(0), float(2 * errors.max()), found.distance, found.n_jumps, dtype, domain)
    largest = highest(tree.leaf_forms, domain.low, domain.high).max(axis=0)
    after = _after_head(tree.head, errors, largest, rounding) * _UP
    return FloatErrorBound(float(after.max()), after, 0.0, found.distance, found.n_jumps, dtype, domain)


class _Rounding:
    """The rounding of a type over a box."""

    def __init__(self, box: Domain, dtype: CType) -> None:
        info = np.finfo(np.float32 if dtype == "float" else np.float64)
        self.dtype, self.box, self.low, self.high = dtype, box, box.low, box.high
        self.u, self.tiny, self.largest = float(info.eps) / 2, float(info.tiny), float(info.max)

    def rounded(self, values: FloatArray) -> FloatArray:
        """Return numbers as literals of the type have them."""
        if self.dtype == "double":
            return values
        return np.array([float(literal(value, "float")[:-1]) for value in values.ravel().tolist()]).reshape(
            values.shape
        )

    def of_rows(self, rows: FloatArray) -> FloatArray:
        """Return what is computed of affine rows (n, d + 1), less what they are, at most: (n,)."""
        if not len(rows):
            return np.zeros(0)
        held, d = self.rounded(rows), rows.shape[1] - 1
        errors = np.asarray(reach(held - rows, self.low, self.high))
        layout = row_layout(distinct_rows(rows)[0], self.dtype)
        sums = [_Sum(self, held[:, -1])]
        order = list(range(d))
        if layout == "dense":  # as `row_table` has it: in two parts
            sums.append(_Sum(self, np.zeros(len(held))))
            order = [*range(d - d % 2, d), *range(d - d % 2)]
        for k in order:
            part = sums[k % 2 if layout == "dense" and k < d - d % 2 else 0]
            part.add_product(held[:, k], self.low[k], self.high[k])
        total = sums[0] if len(sums) == 1 else sums[0].plus(sums[1])
        size = float(np.abs([total.low, total.high]).max() + total.error.max())
        if not size < self.largest:
            raise ValueError(f"over the box a row may reach {size:.3g}, too large for a {self.dtype}")
        return np.asarray((errors + total.error) * _UP)


class _Sum:
    """Partial sums of rows (n,): limits of their exact values, and a bound on the error."""

    def __init__(self, rounding: _Rounding, start: FloatArray) -> None:
        self.rounding = rounding
        self.low, self.high, self.error = start, start, np.zeros(len(start))

    def add_product(self, factor: FloatArray, low: float, high: float) -> None:
        """Add factors times an input between limits; a factor of 0 adds nothing."""
        ends = np.stack((factor * low, factor * high))
        error = np.where(factor == 0, 0.0, self.rounding.u * np.abs(ends).max(axis=0) * _UP + self.rounding.tiny)
        self._add(ends.min(axis=0), ends.max(axis=0), error, factor != 0)

    def plus(self, other: _Sum) -> _Sum:
        """Return the sum of both."""
        self._add(other.low, other.high, other.error, (other.low != 0) | (other.high != 0) | (other.error != 0))
        return self

    def _add(self, low: FloatArray, high: FloatArray, error: FloatArray, rounds: np.ndarray) -> None:
        self.low, self.high = self.low + low, self.high + high
        size = np.maximum(np.abs(self.low), np.abs(self.high)) * _UP
        before = self.error + error
        self.error = before + np.where(rounds, self.rounding.u * (size + before), 0.0)


@singledispatch
def _after_head(head: Head, errors: FloatArray, largest: FloatArray, rounding: _Rounding) -> FloatArray:
    """Return bounds on the errors of answers (o,), given those of the outputs and how large these may be."""
    raise no_entry(head, "float_error")


@_after_head.register
def _(head: Identity, errors: FloatArray, largest: FloatArray, rounding: _Rounding) -> FloatArray:
    return errors


@_after_head.register
def _(head: Exp, errors: FloatArray, largest: FloatArray, rounding: _Rounding) -> FloatArray:
    if (largest + errors > np.log(rounding.largest)).any():
        raise ValueError(f"over the box an output may reach {largest.max():.3g}, whose exp overflows {rounding.dtype}")
    factor = np.expm1(errors) + _LIBRARY * rounding.u * np.exp(errors)
    return np.asarray(np.exp(largest) * factor + rounding.tiny)


@_after_head.register
def _(head: ClipBox, errors: FloatArray, largest: FloatArray, rounding: _Rounding) -> FloatArray:
    limits = head.limits(len(errors))
    return np.asarray(np.max([errors, *(np.abs(rounding.rounded(limit) - limit) for limit in limits)], axis=0))


@_after_head.register
def _(head: TanhBox, errors: FloatArray, largest: FloatArray, rounding: _Rounding) -> FloatArray:
    half, middle = head.halves_and_middles(len(errors))
    squashed = np.minimum(errors, 2.0) + _LIBRARY * rounding.u
    if (half == 1).all() and (middle == 0).all():
        return squashed
    moved = np.sum([np.abs(rounding.rounded(each) - each) for each in (half, middle)], axis=0)
    size = half + np.abs(middle)
    return np.asarray(2 * moved + half * squashed + 3 * rounding.u * size * (1 + squashed) + 2 * rounding.tiny)


@_after_head.register(Sign)
@_after_head.register(Argmax)
def _(head: Head, errors: FloatArray, largest: FloatArray, rounding: _Rounding) -> FloatArray:
    return errors
