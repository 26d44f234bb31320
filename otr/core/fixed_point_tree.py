"""FixedPointTree: an oblique tree that computes in integers alone, bit for bit what its C code does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.core.arrays import FloatArray, IntArray, as_states, read_only
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Identity, Sign, TanhBox
from otr.core.tanh_table import TanhTable
from otr.core.tree import ObliqueTree
from otr.errors import InvalidTreeError

_HEADS = (Identity, ClipBox, TanhBox, Sign, Argmax)
_MANTISSA = 53  # bits of a float64
_CHUNK = 2**16  # states
_WORDS = (8, 16, 32, 64)


@dataclass(frozen=True, eq=False)
class FixedPointTree:
    """An oblique tree of integers: what a controller without floating point computes, proved not to overflow.

    An input x_i comes as the integer q_i, which stands for ``q_i * input_scales[i]``. Then, in integers:

        q_i = min(max(q_i, input_low[i]), input_high[i])
        node i goes left where  v[i] + P[i, 0] q_0 + ... + P[i, d - 1] q_(d - 1) <= 0
        r_k = (c[leaf, k] + half + M[leaf, k, 0] q_0 + ...) >> shifts[leaf, k],   half = (1 << shift) >> 1

    with an arithmetic shift, which rounds to the nearest and halves upwards. The answer is ``labels[leaf]`` or, by the
    head, of r: Identity: r; ClipBox: r within `output_limits`; Argmax: the first largest's label; Sign: r_0 > 0;
    TanhBox: ``table(r)``. An answer integer a_k stands for ``a_k * output_scales[k] + output_offsets[k]``.

    Invariants, verified by `check`, besides those of `ObliqueTree`:
        * |P|, |M| < 2**(bits - 1), and inputs are within +-2**(accumulator_bits - 1);
        * no overflow: for every row, |v| or |c| + half, plus the sum of |coefficient| * max |q|, is below
          2**(accumulator_bits - 1), so that every product and every partial sum is, in any order;
        * so is every number in the interpolation of a table.

    Attributes:
        children_left, children_right: (n_nodes,) int64, as in `ObliqueTree`.
        P, v: (n_nodes, d) and (n_nodes,) int64, the tests.
        M, c, shifts: (n_leaves, o, d), (n_leaves, o), (n_leaves, o) int64, the leaves; 0 in a tree with labels.
        input_low, input_high: (d,) int64, what inputs are clamped to.
        input_scales, output_scales: fractions, (d,) and (o,).
        bits, accumulator_bits: of coefficients; of sums, 32 or 64.
        labels: (n_leaves,) int64, or None.
        head: from a leaf's integers to the answer, that of the policy.
        table: of a TanhBox, else None.
        feature_names, output_names: as in `ObliqueTree`.
    """

    children_left: IntArray
    children_right: IntArray
    P: IntArray
    v: IntArray
    M: IntArray
    c: IntArray
    shifts: IntArray
    input_low: IntArray
    input_high: IntArray
    input_scales: tuple[Fraction, ...]
    output_scales: tuple[Fraction, ...]
    bits: int
    accumulator_bits: int = 32
    labels: IntArray | None = None
    head: Head = field(default_factory=Identity)
    table: TanhTable | None = None
    feature_names: Sequence[str] | None = None
    output_names: Sequence[str] | None = None

    def __post_init__(self) -> None:
        """Take arrays as read-only int64, scales as fractions, and check all.

        Raises:
            InvalidTreeError: an invariant is broken.
        """
        for each in fields(self):
            value = getattr(self, each.name)
            if each.type in ("IntArray", "IntArray | None") and value is not None:
                object.__setattr__(self, each.name, read_only(np.ascontiguousarray(value, dtype=np.int64)))
            elif each.name.endswith("_scales"):
                object.__setattr__(self, each.name, tuple(map(Fraction, value)))
            elif each.name.endswith("_names") and value is not None:
                object.__setattr__(self, each.name, tuple(value))
        self.check()

    @property
    def n_nodes(self) -> int:
        """Number of test nodes."""
        return len(self.v)

    @property
    def n_leaves(self) -> int:
        """Number of leaves."""
        return len(self.c)

    @property
    def n_inputs(self) -> int:
        """Number of inputs d."""
        return len(self.input_low)

    @property
    def n_outputs(self) -> int:
        """Number of outputs o."""
        return int(self.c.shape[1])

    @property
    def input_bits(self) -> int:
        """Bits of the smallest word, 8, 16, 32 or 64, that holds every input."""
        largest = max(-int(self.input_low.min(initial=0)) - 1, int(self.input_high.max(initial=0)))
        return next(bits for bits in _WORDS if largest < 2 ** (bits - 1))

    @property
    def n_bytes(self) -> int:
        """Bytes of all coefficients: distinct tests and leaf rows, shifts, labels and the table."""
        word = next(bits for bits in _WORDS if self.bits <= bits) // 8
        row = word * self.n_inputs + self.accumulator_bits // 8
        n_bytes = row * len(np.unique(np.column_stack((self.P, self.v)), axis=0))
        if self.labels is not None:
            return n_bytes + self.n_leaves
        leaves = np.concatenate((self.M, self.c[..., None], self.shifts[..., None]), axis=2)
        n_bytes += (row + 1) * len(np.unique(leaves.reshape(-1, self.n_inputs + 2), axis=0))
        return n_bytes + (0 if self.table is None else word * self.table.values.size)

    @property
    def leaf_scales(self) -> tuple[Fraction, ...]:
        """What 1 of r_k stands for, before the head: (o,)."""
        unit = None if self.table is None else Fraction(1, 2**self.table.unit_bits)
        return self.output_scales if unit is None else (unit,) * self.n_outputs

    @property
    def output_limits(self) -> tuple[IntArray, IntArray] | None:
        """The integers (o,) that a ClipBox clips to, those nearest to its limits; None under another head."""
        if not isinstance(self.head, ClipBox):
            return None
        limits = (
            [round(Fraction(limit) / scale) for limit, scale in zip(side.tolist(), self.output_scales, strict=True)]
            for side in self.head.limits(self.n_outputs)
        )
        low, high = (np.array(side, dtype=np.int64) for side in limits)
        return low, high

    @property
    def output_offsets(self) -> tuple[Fraction, ...]:
        """What the answer 0 stands for: (o,), the middle of a TanhBox, else 0."""
        if not isinstance(self.head, TanhBox):
            return (Fraction(0),) * self.n_outputs
        limits = zip(*(side.tolist() for side in self.head.limits(self.n_outputs)), strict=True)
        return tuple((Fraction(low) + Fraction(high)) / 2 for low, high in limits)

    def to_integers(self, X: ArrayLike) -> IntArray:
        """Return states (n, d) or (d,) as the integers nearest to x / scale, of two the even one, clamped."""
        states = as_states(X, self.n_inputs)
        if np.isnan(states).any():
            raise ValueError("a state holds NaN, which no integer stands for")
        nearest = np.rint(states / np.array([float(scale) for scale in self.input_scales]))
        return np.asarray(np.clip(nearest, self.input_low, self.input_high).astype(np.int64))

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the answers to real states, scaled back: (n, o) or (n,) labels; (o,) or a label for one state."""
        answers = self.predict_integers(self.to_integers(X))
        if self.labels is not None or self.head.gives_labels:
            return answers
        scales, offsets = ([float(value) for value in each] for each in (self.output_scales, self.output_offsets))
        return np.asarray(answers * np.array(scales) + offsets)

    def predict_integers(self, Q: ArrayLike) -> IntArray:
        """Return what the C code answers to integers (n, d) or (d,): (n, o) or (n,) labels, as `predict` does."""
        given = np.asarray(Q)
        if given.dtype.kind not in "iu":
            raise TypeError(f"the inputs are of type {given.dtype}, expected integers; predict takes real states")
        as_states(given, self.n_inputs)
        clamped = np.clip(np.atleast_2d(given), self.input_low, self.input_high).astype(np.int64)
        parts = [self._answers(clamped[at : at + _CHUNK]) for at in range(0, max(len(clamped), 1), _CHUNK)]
        answers = np.concatenate(parts)
        return answers if given.ndim == 2 else np.asarray(answers[0])

    def apply_integers(self, Q: IntArray) -> IntArray:
        """Return the leaves (n,) of integers (n, d), which are within the clamp."""
        at = np.full(len(Q), 0 if self.n_nodes else -1, dtype=np.int64)
        for _ in self._exact_tree.levels:
            rows = np.flatnonzero(at >= 0)
            nodes = at[rows]
            left = (self.P[nodes] * Q[rows]).sum(axis=1) + self.v[nodes] <= 0
            at[rows] = np.where(left, self.children_left[nodes], self.children_right[nodes])
        return ~at

    def _answers(self, Q: IntArray) -> IntArray:
        leaves = self.apply_integers(Q)
        if self.labels is not None:
            return np.asarray(self.labels[leaves])
        shifts = self.shifts[leaves]
        sums = self.c[leaves] + ((1 << shifts) >> 1) + (self.M[leaves] * Q[:, None, :]).sum(axis=2)
        r = sums >> shifts
        if self.table is not None:
            return self.table(r)
        if self.output_limits is not None:
            return np.asarray(np.clip(r, *self.output_limits))
        return np.asarray(self.head(r))  # of integers, Identity and labels are as of numbers

    def dyadic_scales(self) -> tuple[tuple[Fraction, ...], tuple[Fraction, ...]]:
        """Return numbers of few binary digits next to 1 / input_scales and to leaf_scales, as `to_tree` has them.

        Scales that are powers of two are these themselves. All sums and products with them are exact in float64.
        """
        n_bits = min(18, (_MANTISSA - self.bits) // 2)
        inputs = tuple(_near(1 / scale, n_bits) for scale in self.input_scales)
        return inputs, tuple(_near(scale, n_bits) for scale in self.leaf_scales)

    def to_tree(self) -> ObliqueTree:
        """Return the tree of real numbers with these tests and leaves, before any rounding of inputs and outputs.

        On ``x = q / t`` with t those of `dyadic_scales`, its outputs before the head are the sums above as they are
        before the shift, so what the integers answer is that up to the rounding by the shift and by the head.
        """
        return self._exact_tree

    @cached_property
    def _exact_tree(self) -> ObliqueTree:
        inputs, outputs = self.dyadic_scales()
        steps = np.array(outputs, dtype=object) / np.array(2 ** self.shifts.astype(object), dtype=object)
        P = _exact("P", self.P.astype(object) * np.array(inputs, dtype=object))
        M = _exact("M", self.M.astype(object) * np.array(inputs, dtype=object) * steps[..., None])
        return ObliqueTree(
            self.children_left,
            self.children_right,
            P,
            _exact("v", self.v.astype(object)),
            M,
            _exact("c", self.c.astype(object) * steps),
            labels=self.labels,
            head=self.head,
            feature_names=self.feature_names,
            output_names=self.output_names,
        )

    def _repr_svg_(self) -> str:
        """Return the picture that a notebook shows: that of the tree of real numbers."""
        return self.to_tree()._repr_svg_()

    def replace(self, **changes: Any) -> FixedPointTree:
        """Return the tree with other arrays or settings, checked, and all else as it is."""
        return replace(self, **changes)

    def check(self) -> None:
        """Verify the invariants in the class's docstring.

        Raises:
            InvalidTreeError: names the row, or the array, and both numbers.
        """
        if not isinstance(self.head, _HEADS):
            raise no_entry(self.head, "a FixedPointTree")
        self._check_numbers()
        largest = np.maximum(abs(self.input_low.astype(object)), abs(self.input_high.astype(object)))
        tests = abs(self.P.astype(object)) @ largest + abs(self.v.astype(object))
        half = 2 ** self.shifts.astype(object) // 2
        leaves = abs(self.M.astype(object)) @ largest + abs(self.c.astype(object)) + half
        for what, sums in (("test", tests), ("leaf, output", leaves)):
            over = np.argwhere(sums >= 2 ** (self.accumulator_bits - 1))
            if over.size:
                at = tuple(over[0].tolist())
                raise InvalidTreeError(
                    f"{what} {', '.join(map(str, at))}: sums of its row may reach {sums[at]}, and an accumulator of "
                    f"{self.accumulator_bits} bits holds {2 ** (self.accumulator_bits - 1) - 1}"
                )
        if self.table is not None:
            self._check_table(self.table)
        self._exact_tree.check()

    def _check_numbers(self) -> None:
        if self.accumulator_bits not in (32, 64) or not 2 <= self.bits <= 24:
            raise InvalidTreeError(
                f"accumulator_bits is {self.accumulator_bits} and bits {self.bits}, expected 32 or 64, and 2 to 24"
            )
        shapes = {
            "input_high": (self.n_inputs,),
            "P": (self.n_nodes, self.n_inputs),
            "M": (self.n_leaves, self.n_outputs, self.n_inputs),
            "shifts": self.c.shape,
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InvalidTreeError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")
        scales = (*self.input_scales, *self.output_scales)
        if (len(self.input_scales), len(self.output_scales)) != (self.n_inputs, self.n_outputs) or min(scales) <= 0:
            raise InvalidTreeError(f"the scales are {scales}, expected one above 0 for each input and output")
        limit = 2 ** (self.bits - 1)
        for name in ("P", "M"):
            largest = int(np.abs(getattr(self, name)).max(initial=0))
            if largest >= limit:
                raise InvalidTreeError(
                    f"{name} holds {largest}, and coefficients of {self.bits} bits are below {limit}"
                )
        if self.shifts.min(initial=0) < 0 or self.shifts.max(initial=0) > self.accumulator_bits - 2:
            raise InvalidTreeError(f"shifts are {self.shifts.min()} to {self.shifts.max()}, expected 0 or more")
        if (self.input_low > self.input_high).any():
            raise InvalidTreeError(f"input_low is {self.input_low}, above input_high, {self.input_high}")

    def _check_table(self, table: TanhTable) -> None:
        values, (n_tables, n_knots) = table.values, table.values.shape
        largest = int(np.abs(np.diff(values)).max(initial=0)) << table.step_bits
        if n_tables not in (1, self.n_outputs) or n_knots < 2 or values[:, 0].any() or (np.diff(values) < 0).any():
            raise InvalidTreeError(f"the table has shape {values.shape}, expected rows that rise from 0")
        if max(largest + table.last, int(values.max())) >= 2 ** (self.accumulator_bits - 1) or table.step_bits < 0:
            raise InvalidTreeError(
                f"interpolation in the table may reach {largest}, and an accumulator of {self.accumulator_bits} bits "
                f"holds {2 ** (self.accumulator_bits - 1) - 1}"
            )

    def __repr__(self) -> str:
        return (
            f"FixedPointTree(n_leaves={self.n_leaves}, n_inputs={self.n_inputs}, n_outputs={self.n_outputs}, "
            f"bits={self.bits}, accumulator_bits={self.accumulator_bits}, n_bytes={self.n_bytes}, head={self.head!r})"
        )


def _near(number: Fraction, n_bits: int) -> Fraction:
    """Return a positive number rounded to so many binary digits."""
    exponent = n_bits - (number.numerator.bit_length() - number.denominator.bit_length())
    unit = Fraction(2) ** -exponent
    return round(number / unit) * unit


def _exact(name: str, values: NDArray[Any]) -> FloatArray:
    """Return numbers as float64; raise InvalidTreeError if one is not exactly that."""
    rounded = values.astype(np.float64)
    for value, number in zip(values.ravel().tolist(), rounded.ravel().tolist(), strict=True):
        if Fraction(number) != value:
            raise InvalidTreeError(
                f"{name} holds a number that no float64 is: give scales that are powers of two, or fewer bits"
            )
    return np.asarray(rounded)
