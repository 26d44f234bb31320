"""Tables of tanh in integers, and by how much they are off, in rational arithmetic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache

import numpy as np

from otr.core.fixed_point.tanh_table import TanhTable

_CURVATURE = Fraction(7699, 10_000)  # above max |tanh''| = 4 / (3 sqrt 3) = 0.76980
_TERMS = 96  # of exp's series, of which the rest is below 1e-20 up to exp(22)


def tanh_table(amplitudes: Sequence[Fraction], unit_bits: int, bits: int) -> TanhTable:
    """Return the table of amplitude * tanh, one row where all amplitudes are the same.

    It has 2**((bits - 5) // 2) steps a unit of the argument, so that interpolation is off by about 3 integers, and ends
    where all that is left of the amplitude is half an integer.
    """
    largest = max(amplitudes)
    end = max(1, math.ceil(math.log(4 * float(largest)) / 2))
    steps_bits = max(0, min(max(2, (bits - 5) // 2), unit_bits))
    knots = [Fraction(k, 2**steps_bits) for k in range(end * 2**steps_bits + 1)]
    rows = amplitudes[:1] if len(set(amplitudes)) == 1 else amplitudes
    values = [[round(amplitude * tanh_bounds(u)[0]) for u in knots] for amplitude in rows]
    return TanhTable(np.array(values, dtype=np.int64), unit_bits, unit_bits - steps_bits)


def table_error(table: TanhTable, output: int, amplitude: Fraction) -> Fraction:
    """Return a bound on |table(r) - amplitude * tanh(r * unit)| over all integers r, in integers of the table.

    A step of length h adds h^2 / 8 max |tanh''| to the error of its knots, and the rounding of the interpolation.
    """
    values = table.values[output % len(table.values)].tolist()
    step = Fraction(2) ** (table.step_bits - table.unit_bits)
    at_knots = Fraction(0)
    for k, value in enumerate(values):
        low, high = tanh_bounds(k * step)
        at_knots = max(at_knots, abs(value - amplitude * low), abs(value - amplitude * high))
    between = amplitude * step**2 / 8 * _CURVATURE + (Fraction(1, 2) if table.step_bits else 0)
    return max(at_knots + between, Fraction(amplitude - values[-1]))


@lru_cache(maxsize=2**14)
def tanh_bounds(u: Fraction) -> tuple[Fraction, Fraction]:
    """Return numbers that tanh(u) is between, of 0 <= u <= 11; exp(2 u) by its series and the bound of its rest."""
    z = 2 * u
    if not 0 <= z <= 22:
        raise ValueError(f"u is {u}, expected 0 to 11")
    total, term = Fraction(1), Fraction(1)
    for k in range(1, _TERMS):
        term = term * z / k
        total += term
    rest = term * z / _TERMS / (1 - z / (_TERMS + 1))
    return 1 - 2 / (total + 1), 1 - 2 / (total + rest + 1)
