"""What an expression is worth on one path: a function of the inputs that is affine, but for a last step perhaps."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Affine:
    """``sum of terms[i] * x[i] + offset``; no coefficient is zero."""

    terms: dict[int, float]
    offset: float

    @property
    def is_constant(self) -> bool:
        """Whether no input has a part in it."""
        return not self.terms

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        return math.isfinite(self.offset) and all(map(math.isfinite, self.terms.values()))

    @property
    def key(self) -> tuple[object, ...]:
        """Equal exactly for equal functions."""
        return (*sorted(self.terms.items()), self.offset)

    def times(self, factor: float) -> Affine:
        """Return a multiple."""
        terms = {i: product for i, value in self.terms.items() if (product := value * factor) != 0}
        return Affine(terms, self.offset * factor)

    def over(self, divisor: float) -> Affine:
        """Return a fraction; dividing is not the same as multiplying by a rounded inverse."""
        terms = {i: quotient for i, value in self.terms.items() if (quotient := value / divisor) != 0}
        return Affine(terms, self.offset / divisor)

    def minus(self, other: Affine) -> Affine:
        """Return the difference."""
        return Affine.sum([(1.0, self), (-1.0, other)])

    @staticmethod
    def sum(values: Iterable[tuple[float, Affine]]) -> Affine:
        """Return the sum of functions, each times its sign."""
        terms: dict[int, float] = {}
        offset = 0.0
        for sign, value in values:
            offset += sign * value.offset
            for i, coefficient in value.terms.items():
                terms[i] = terms.get(i, 0.0) + sign * coefficient
        return Affine({i: coefficient for i, coefficient in terms.items() if coefficient != 0}, offset)


@dataclass(frozen=True, slots=True)
class Clipped:
    """``min(max(inner, low), high)`` with low < high, of which one may be infinite; `inner` may be constant."""

    inner: Affine
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Squashed:
    """``half * tanh(inner) + middle`` with half > 0."""

    inner: Affine
    half: float
    middle: float

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        return self.inner.is_finite and math.isfinite(self.half) and math.isfinite(self.middle)

    def signed(self, sign: float) -> Squashed:
        """Return the function, or for sign -1 its negative: tanh is odd, so that `half` stays positive."""
        return self if sign > 0 else Squashed(self.inner.times(-1.0), self.half, -self.middle)

    def times(self, factor: float) -> Squashed | Affine:
        """Return a multiple."""
        half, signed = self.half * abs(factor), self.signed(factor)
        return Squashed(signed.inner, half, self.middle * factor) if half else constant(self.middle * factor)

    def over(self, divisor: float) -> Squashed | Affine:
        """Return a fraction."""
        half, signed = self.half / abs(divisor), self.signed(divisor)
        return Squashed(signed.inner, half, self.middle / divisor) if half else constant(self.middle / divisor)

    def plus(self, offset: float) -> Squashed:
        """Return the sum with a constant."""
        return Squashed(self.inner, self.half, self.middle + offset)


@dataclass(frozen=True, slots=True)
class Exponential:
    """``exp(inner)``."""

    inner: Affine


Value: TypeAlias = Affine | Clipped | Squashed | Exponential


def constant(value: float) -> Affine:
    """Return a constant function."""
    return Affine({}, value)


def clipped(value: Affine | Clipped, low: float = -math.inf, high: float = math.inf) -> Affine | Clipped:
    """Return ``min(max(value, low), high)`` for low <= high; one clip on top of another is one clip."""
    inner = value.inner if isinstance(value, Clipped) else value
    if isinstance(value, Clipped):
        low, high = min(max(value.low, low), high), min(max(value.high, low), high)
    if low == high:
        return constant(low)
    if inner.is_constant and not (math.isfinite(low) and math.isfinite(high)):
        return constant(min(max(inner.offset, low), high))
    return Clipped(inner, low, high)
