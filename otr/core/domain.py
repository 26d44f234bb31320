"""The states that a question is asked about: all of R^d, or a box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import BoolArray, FloatArray, as_batch, read_only
from otr.core.half_spaces import HalfSpaces, rounding_of_terms


class Limits(Protocol):
    """Anything with a lowest and a highest state, such as gymnasium's Box spaces."""

    low: Any
    high: Any


Box = tuple[ArrayLike, ArrayLike] | Limits  # low (d,), high (d,)
WIDEST = 1e100
_FARTHEST = 1e150  # a hyperplane beyond meets nothing: of a box truly, of an open side by definition


class Domain:
    """A box [low, high] in R^d, any side of which may be infinite; in scaled coordinates a finite one is [-1, 1].

    An infinite side counts as far as 1e150: a test beyond meets nothing. Where low is high, the input is a constant.

    Attributes:
        low, high: (d,) float64.
    """

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        """Keep the limits.

        Raises:
            ValueError: a limit is NaN, low is above high or an infinity, a finite side is too wide or too narrow, or
                the shapes differ.
        """
        self.low: FloatArray = read_only(np.array(low, dtype=np.float64))
        self.high: FloatArray = read_only(np.array(high, dtype=np.float64))
        if self.low.shape != self.high.shape or self.low.ndim != 1:
            raise ValueError(
                f"low has shape {self.low.shape} and high {self.high.shape}, expected (n_inputs,) for both"
            )
        wrong = np.flatnonzero(~((self.low <= self.high) & (self.low < np.inf) & (self.high > -np.inf)))
        if wrong.size:
            i = int(wrong[0])
            raise ValueError(f"input {i} has the limits {self.low[i]:g} and {self.high[i]:g}, expected low <= high")
        finite = np.isfinite(self.low) & np.isfinite(self.high)
        limits = np.abs(np.stack((self.low, self.high)))
        wide = np.flatnonzero((np.isfinite(limits) & (limits > WIDEST)).any(axis=0))
        if wide.size:
            i = int(wide[0])
            raise ValueError(
                f"input {i} has the limits {self.low[i]:g} and {self.high[i]:g}, wider than {WIDEST:g}; "
                "leave such a side open: -inf, inf"
            )
        is_narrow = (self.low < self.high) & (self.high - self.low < 2 * np.finfo(np.float64).tiny)
        narrow = np.flatnonzero(finite & is_narrow)
        if narrow.size:
            i = int(narrow[0])
            raise ValueError(
                f"input {i} has the limits {self.low[i]:g} and {self.high[i]:g}, nearer than float64 resolves"
            )
        with np.errstate(invalid="ignore"):
            self._scale = np.where(finite, (self.high - self.low) / 2, 1.0)
            self._middle = np.where(finite, self.low + self._scale, 0.0)

    @property
    def n_inputs(self) -> int:
        """Number of inputs d."""
        return len(self.low)

    @property
    def is_bounded(self) -> bool:
        """Whether every side is finite."""
        return bool(np.isfinite(self.low).all() and np.isfinite(self.high).all())

    def require_bounded(self) -> None:
        """Raise ValueError unless every side is finite."""
        if not self.is_bounded:
            i = int(np.flatnonzero(~(np.isfinite(self.low) & np.isfinite(self.high)))[0])
            raise ValueError(
                f"input {i} has the limits {self.low[i]:g} and {self.high[i]:g}, expected a bounded box: give a finite "
                "low and high for every input"
            )

    def contains(self, X: ArrayLike) -> BoolArray:
        """Return which of the states (n, d) are in the box, sides included: (n,); NaN is in no box."""
        states = as_batch(X, self.n_inputs)
        inside: BoolArray = np.all((self.low <= states) & (states <= self.high), axis=1)
        return inside

    @property
    def n_bounded(self) -> int:
        """Number of inputs that have two limits."""
        return int((np.isfinite(self.low) & np.isfinite(self.high)).sum())

    def sides(self, *, in_box: bool = False) -> tuple[FloatArray, tuple[str, ...]]:
        """Return the finite sides as affine forms [a | b] (m, d + 1), 0 or more inside, and their names; lows first.

        With `in_box` only those of inputs of which the other side is infinite.
        """
        identity = np.eye(self.n_inputs)
        asked = np.isinf(self.low) | np.isinf(self.high) if in_box else np.ones(self.n_inputs, dtype=np.bool_)
        lows, highs = (np.flatnonzero(np.isfinite(limits) & asked) for limits in (self.low, self.high))
        forms = np.concatenate(
            (np.column_stack((identity[lows], -self.low[lows])), np.column_stack((-identity[highs], self.high[highs])))
        )
        return forms, (*(f"low {i}" for i in lows.tolist()), *(f"high {i}" for i in highs.tolist()))

    def rows(self, *, in_box: bool = False) -> HalfSpaces:
        """Return the finite sides as rows in scaled coordinates, one group, in the order of `sides`."""
        forms, _ = self.sides(in_box=in_box)
        if in_box:
            return replace(self.rows_of(forms[None]), in_box=True)
        rows, inputs = self.rows_of(forms[None]), np.abs(forms[:, :-1]).argmax(axis=1)
        # Of a constant input those of its scaled coordinate, which nothing depends on: so polytopes have an inside.
        at = np.flatnonzero(self._scale[inputs] == 0)
        rows.a[0, at, inputs[at]], rows.b[0, at] = forms[at, inputs[at]], 1.0
        return rows

    def scaled(self, forms: FloatArray) -> FloatArray:
        """Return affine forms [P | v] (..., d + 1) in scaled coordinates, of the same values."""
        P = forms[..., :-1]
        return np.concatenate((P * self._scale, (forms[..., -1] + P @ self._middle)[..., None]), axis=-1)

    def rows_of(self, forms: FloatArray, sizes: FloatArray | None = None) -> HalfSpaces:
        """Return affine forms [P | v] (n_groups, m, d + 1) as rows in scaled coordinates.

        A form without a slope, up to rounding, becomes a row whose normal is 0 and whose value is 1 or -1, by its sign.

        Args:
            forms: the forms.
            sizes: of the terms whose sums the forms' numbers are; None where these are exact.
        """
        sizes = np.abs(forms) if sizes is None else sizes
        # By powers of two, so that no square overflows and none is lost.
        exponents = np.frexp(np.maximum(sizes[..., :-1] * self._scale, np.finfo(np.float64).tiny).max(axis=-1))[1]
        exponents = np.where((sizes[..., :-1] * self._scale).any(axis=-1), exponents, 0)
        unit = np.ldexp(1.0, -np.clip(exponents, -1000, 1000))[..., None]
        scaled, sizes = self.scaled(forms * unit), sizes * unit
        a, b = scaled[..., :-1], scaled[..., -1]
        rounding = rounding_of_terms(self.n_inputs)
        slopes = rounding * sizes[..., :-1]
        a = np.where(np.abs(a) <= slopes * self._scale, 0.0, a)
        fixed = rounding * sizes[..., -1] + slopes @ np.abs(self._middle)
        length = np.sqrt(np.einsum("...d,...d->...", a, a))
        flat = length * _FARTHEST <= np.abs(b)
        length = np.where(flat, 1.0, length)
        errors = np.concatenate((slopes * self._scale, fixed[..., None]), axis=-1) / length[..., None]
        a, b = a / length[..., None], b / length
        a[flat], b[flat], errors[flat] = 0.0, np.where(b[flat] > 0, 1.0, -1.0), 0.0
        is_open = ~(np.isfinite(self.low) & np.isfinite(self.high))
        return HalfSpaces(a, b, length / unit[..., 0], errors, is_open)

    def reach(self, a: FloatArray) -> FloatArray:
        """Return the largest |a . x| over the domain, scaled, for normals (..., d); inf where it is open."""
        is_open = ~(np.isfinite(self.low) & np.isfinite(self.high))
        reach: FloatArray = np.abs(a[..., ~is_open]).sum(axis=-1)
        return np.where(a[..., is_open].any(axis=-1), np.inf, reach)

    def length(self, form: FloatArray) -> float:
        """Return the length of the normal of an affine form (d + 1,) in scaled coordinates."""
        return float(np.linalg.norm(form[:-1] * self._scale))

    def unscaled(self, X: FloatArray) -> FloatArray:
        """Return scaled states (n, d) in the inputs' own units."""
        states: FloatArray = X * self._scale + self._middle
        return states

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description; an infinite side is None."""

        def listed(limits: FloatArray) -> list[float | None]:
            return [value if np.isfinite(value) else None for value in limits.tolist()]

        return {"low": listed(self.low), "high": listed(self.high)}

    @classmethod
    def from_dict(cls, description: dict[str, Sequence[float | None]]) -> Domain:
        """Return the domain that `to_dict` described."""
        low = [-np.inf if value is None else value for value in description["low"]]
        high = [np.inf if value is None else value for value in description["high"]]
        return cls(low, high)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Domain) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((tuple(self.low.tolist()), tuple(self.high.tolist())))

    def __repr__(self) -> str:
        return f"Domain({self.low.tolist()}, {self.high.tolist()})"


def as_domain(domain: Domain | Box | None, n_inputs: int) -> Domain:
    """Return the `Domain` of a pair (low, high), or numbers for all inputs, or None for R^d; raise ValueError else.

    Anything with `low` and `high` is such a pair, as gymnasium's Box spaces are.
    """
    if domain is None:
        return Domain(np.full(n_inputs, -np.inf), np.full(n_inputs, np.inf))
    if not isinstance(domain, Domain):
        if isinstance(domain, tuple | list) and len(domain) == 2:
            low, high = domain
        elif hasattr(domain, "low") and hasattr(domain, "high"):
            low, high = np.ravel(domain.low), np.ravel(domain.high)
        else:
            raise ValueError(
                f"the domain is {domain!r}, expected None, a pair (low, high), a Box space or an otr.Domain"
            )
        shape = (n_inputs,)
        if np.ndim(low) == 0 and np.ndim(high) == 0:
            low, high = np.broadcast_to(low, shape), np.broadcast_to(high, shape)
        domain = Domain(low, high)
    if domain.n_inputs != n_inputs:
        raise ValueError(f"the domain has {domain.n_inputs} inputs, expected {n_inputs}")
    return domain
