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
from otr.core.fixed_point.tanh_table import TanhTable
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Identity, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.errors import InvalidTreeError

HEADS_OF_INTEGERS = (Identity, ClipBox, TanhBox, Sign, Argmax)
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
        pairs = (zip(side.tolist(), self.output_scales, strict=True) for side in self.head.limits(self.n_outputs))
        low, high = ([round(Fraction(limit) / scale) for limit, scale in side] for side in pairs)
        return np.array(low), np.array(high)

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
        if not isinstance(self.head, HEADS_OF_INTEGERS):
            raise no_entry(self.head, "a FixedPointTree")
        d, o, n_leaves = self.n_inputs, self.n_outputs, self.n_leaves
        shapes = {"input_high": (d,), "P": (self.n_nodes, d), "M": (n_leaves, o, d), "shifts": (n_leaves, o)}
        for name, shape in shapes.items():
            _require(getattr(self, name).shape == shape, f"{name} has shape {getattr(self, name).shape}", shape)
        scales, sizes = (self.input_scales, self.output_scales), (self.accumulator_bits, self.bits, self.input_bits)
        _require(tuple(map(len, scales)) == (d, o), f"there are scales {scales}", (d, o))
        _require(min(map(min, scales)) > 0, f"the scales are {scales}", "numbers above 0")
        _require(
            sizes[0] in (32, 64) and 2 <= sizes[1] <= 24, f"sums and words have {sizes[:2]} bits", "32 or 64, 2 to 24"
        )
        is_box = bool((self.input_low <= self.input_high).all())
        _require(is_box, f"input_low is {self.input_low}", f"at most {self.input_high}")
        _require(sizes[2] <= sizes[0], f"inputs have {sizes[2]} bits", f"at most {sizes[0]}")
        for name in ("P", "M"):
            largest, limit = int(np.abs(getattr(self, name)).max(initial=0)), 2 ** (self.bits - 1)
            _require(largest < limit, f"{name} holds {largest}, of {self.bits} bits", f"below {limit}")
        ends = self.shifts.min(initial=0), self.shifts.max(initial=0)
        _require(ends[0] >= 0 and ends[1] <= sizes[0] - 2, f"shifts are {ends}", "0 or more")
        self._check_sums()
        self._exact_tree.check()

    def _check_sums(self) -> None:
        """Raise InvalidTreeError unless every sum, and every number after it, is below what the accumulator holds."""
        largest = np.maximum(abs(self.input_low.astype(object)), abs(self.input_high.astype(object)))
        half = 2 ** self.shifts.astype(object) // 2
        reached = {
            "test": abs(self.P.astype(object)) @ largest + abs(self.v.astype(object)),
            "leaf, output": abs(self.M.astype(object)) @ largest + abs(self.c.astype(object)) + half,
            "limit": np.abs(self.output_limits or [0]).max(axis=0),
        }
        if self.table is not None:
            values, (n_tables, n_knots) = self.table.values, self.table.values.shape
            rises = n_tables in (1, self.n_outputs) and n_knots > 1 and not values[:, 0].any()
            rises = rises and (np.diff(values) >= 0).all() and self.table.step_bits >= 0
            _require(bool(rises), f"the table has shape {values.shape}", "rows that rise from 0")
            steps = np.diff(values).astype(object) * 2**self.table.step_bits
            reached["table, step"] = np.maximum(steps + self.table.last, values[:, 1:])
        most = 2 ** (self.accumulator_bits - 1) - 1
        for what, sums in reached.items():
            for at in np.argwhere(sums > most)[:1].tolist():
                what = f"{what} {', '.join(map(str, at))}: sums of its row may reach {sums[tuple(at)]}"
                _require(False, what, f"at most {most}, which an accumulator of {self.accumulator_bits} bits holds")

    def __repr__(self) -> str:
        return (
            f"FixedPointTree(n_leaves={self.n_leaves}, n_inputs={self.n_inputs}, n_outputs={self.n_outputs}, "
            f"bits={self.bits}, accumulator_bits={self.accumulator_bits}, n_bytes={self.n_bytes}, head={self.head!r})"
        )


def _require(holds: bool, what: str, expected: object) -> None:
    if not holds:
        raise InvalidTreeError(f"{what}, expected {expected}")


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
