"""TanhTable: tanh in integers alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from otr.core.arrays import IntArray, read_only


@dataclass(frozen=True, eq=False)
class TanhTable:
    """tanh as a table of integers with linear interpolation, for an argument in units of ``2**-unit_bits``.

    With a = |r|, at most n_steps << step_bits, its step k = a >> step_bits and the rest f = a - (k << step_bits), the
    value is T[k] + (((T[k + 1] - T[k]) * f + half) >> step_bits), half = (1 << step_bits) >> 1, with r's sign.

    Attributes:
        values: (1, n_steps + 1) for all outputs or (o, n_steps + 1), int64, T: the first of each row is 0.
        unit_bits, step_bits: a step is ``2**step_bits`` units of the argument.
    """

    values: IntArray
    unit_bits: int
    step_bits: int

    def __post_init__(self) -> None:
        """Take the values as read-only int64."""
        object.__setattr__(self, "values", read_only(np.ascontiguousarray(self.values, dtype=np.int64)))

    @property
    def last(self) -> int:
        """The largest |r| that the table distinguishes from larger ones."""
        return int(self.values.shape[1] - 1) << self.step_bits

    def __call__(self, r: IntArray) -> IntArray:
        """Return the values of integers (n, o)."""
        a = np.minimum(np.abs(r), self.last)
        step = np.minimum(a >> self.step_bits, self.values.shape[1] - 2)
        rest, row = a - (step << self.step_bits), np.arange(r.shape[-1]) % len(self.values)
        low, high = self.values[row, step], self.values[row, step + 1]
        value = low + (((high - low) * rest + ((1 << self.step_bits) >> 1)) >> self.step_bits)
        return np.asarray(np.where(r < 0, -value, value))
