"""Bounds of heads for proofs: for each action the exact value, and lines above it.

An action weighed by a number w is bounded by an affine function of its output y, a line nowhere below ``w * h(y)`` on
an interval. Under an affine head and a clip, lines and values are exact; under tanh and exp they are as exact as
float64 is.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from fractions import Fraction
from functools import singledispatch

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, Sign, TanhBox
from otr.core.tree import ObliqueTree, require_tree
from otr.errors import OtrError

_TANH = Fraction(1, 10**12)  # of an action's range: up to where float64 knows a tanh

_EXP = Fraction(1, 10**12)  # of the value: up to where float64 knows an exp
_MOST = 700  # of an output whose exp is a float64

Line = tuple[float, float | Fraction]  # slope and offset


class Action(ABC):
    """One action as a function h of its output y, which never falls as that rises; `is_exact`: without rounding."""

    is_exact = True

    def pieces(self) -> tuple[tuple[float, float], ...]:
        """Return intervals of y that make up the line, on each of which the action is affine if it is exact."""
        return ((-math.inf, math.inf),)

    @abstractmethod
    def value(self, y: Fraction) -> tuple[Fraction, Fraction]:
        """Return h(y), and a bound on its error: 0 where it is exact."""

    @abstractmethod
    def near(self, y: FloatArray) -> FloatArray:
        """Return h(y) in float64."""

    @abstractmethod
    def line_above(self, weight: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slopes and offsets of lines nowhere below ``weight * h(y)`` between low and high (n,)."""

    def exact_line(self, weight: float, slope: float, offset: float) -> Line:
        """Return a line of `line_above`, without the rounding of its products where that can be undone."""
        return float(slope), float(offset)

    @abstractmethod
    def turns(self, weight: float, slope: float, low: float, high: float) -> set[float]:
        """Return where a line of this slope, less ``weight * h(y)``, may be smallest within an interval."""

    @abstractmethod
    def stays_above(self, weight: float, slope: float, low: float, high: float) -> bool:
        """Return whether a line of this slope stays above ``weight * h(y)`` towards the open ends of an interval."""


class _AffineAction(Action):
    """h(y) = y."""

    def value(self, y: Fraction) -> tuple[Fraction, Fraction]:
        return y, Fraction(0)

    def near(self, y: FloatArray) -> FloatArray:
        return y

    def line_above(self, weight: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.full(len(low), weight), np.zeros(len(low))

    def turns(self, weight: float, slope: float, low: float, high: float) -> set[float]:
        return {0.0}

    def stays_above(self, weight: float, slope: float, low: float, high: float) -> bool:
        return Fraction(slope) == Fraction(weight)


@dataclass(frozen=True)
class _ClippedAction(Action):
    """h(y) = min(max(y, bottom), top)."""

    bottom: float
    top: float

    def pieces(self) -> tuple[tuple[float, float], ...]:
        return (-math.inf, self.bottom), (self.bottom, self.top), (self.top, math.inf)

    def value(self, y: Fraction) -> tuple[Fraction, Fraction]:
        return min(max(y, Fraction(self.bottom)), Fraction(self.top)), Fraction(0)

    def near(self, y: FloatArray) -> FloatArray:
        return np.clip(y, self.bottom, self.top)

    def line_above(self, weight: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        inside = np.isfinite(low) & np.isfinite(high)
        constant = np.where(np.isfinite(high), self.bottom, self.top)
        return np.where(inside, weight, 0.0), np.where(inside, 0.0, weight * constant)

    def exact_line(self, weight: float, slope: float, offset: float) -> Line:
        if slope != 0:
            return float(slope), float(offset)
        ends = (self.bottom, self.top)
        return 0.0, next(Fraction(weight) * Fraction(end) for end in ends if weight * end == offset)

    def turns(self, weight: float, slope: float, low: float, high: float) -> set[float]:
        return {y for y in (self.bottom, self.top) if low < y < high}

    def stays_above(self, weight: float, slope: float, low: float, high: float) -> bool:
        return (math.isfinite(low) or slope <= 0) and (math.isfinite(high) or slope >= 0)


@dataclass(frozen=True)
class _TanhAction(Action):
    """h(y) = bottom + (tanh(y) + 1) / 2 * (top - bottom)."""

    bottom: float
    top: float
    is_exact = False

    def value(self, y: Fraction) -> tuple[Fraction, Fraction]:
        low, high = Fraction(self.bottom), Fraction(self.top)
        squashed = Fraction(math.tanh(min(max(y, Fraction(-40)), Fraction(40))))
        return low + (squashed + 1) / 2 * (high - low), _TANH * (high - low)

    def near(self, y: FloatArray) -> FloatArray:
        half, middle = self._half_and_middle()
        return np.asarray(middle + half * np.tanh(y))

    def _half_and_middle(self) -> tuple[float, float]:
        return (self.top - self.bottom) / 2, (self.top + self.bottom) / 2

    def line_above(self, weight: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        half, middle = self._half_and_middle()
        if weight < 0:  # weight tanh(y) = -weight tanh(-y)
            slope, offset = tanh_line(-high, -low)
            slope = -slope
        else:
            slope, offset = tanh_line(low, high)
        scale = abs(weight) * half
        return scale * slope, scale * offset + weight * middle

    def turns(self, weight: float, slope: float, low: float, high: float) -> set[float]:
        half = (Fraction(self.top) - Fraction(self.bottom)) / 2
        share = slope / (weight * float(half))
        if not 0 < share < 1:
            return set()
        # Where the line is parallel to the curve: atanh(sqrt(1 - share)), without the difference that rounds to 1.
        turn = math.log((1 + math.sqrt(1 - share)) / math.sqrt(share))
        return {y for y in (-turn, turn) if low < y < high}

    def stays_above(self, weight: float, slope: float, low: float, high: float) -> bool:
        return math.isfinite(low) and math.isfinite(high)


class _ExpAction(Action):
    """h(y) = exp(y), for y up to `_MOST`."""

    is_exact = False

    def value(self, y: Fraction) -> tuple[Fraction, Fraction]:
        if y > _MOST:
            raise OtrError(f"an output reaches {float(y):.6g}, and the exp of more than {_MOST} is not reckoned with")
        count = Fraction(math.exp(max(y, Fraction(-_MOST))))
        return count, _EXP * count if y >= -_MOST else count

    def near(self, y: FloatArray) -> FloatArray:
        return np.asarray(np.exp(y))

    def line_above(self, weight: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the chord where the share is convex, for a positive weight, and the tangent in the middle else."""
        if (high > _MOST).any():
            raise OtrError(
                f"over the box an output may reach {high.max():.6g}, and the exp of more than {_MOST} is not reckoned "
                "with; ask about a smaller box"
            )
        middle, at_low, at_high = (low + high) / 2, np.exp(low), np.exp(high)
        chord = (at_high - at_low) / np.maximum(high - low, 1e-300)
        slope = weight * (chord if weight > 0 else np.exp(middle))
        if weight > 0:
            offset = np.maximum(weight * at_low - slope * low, weight * at_high - slope * high)
        else:
            offset = weight * np.exp(middle) - slope * middle
        rounding = 1e-15 * (np.abs(slope) * np.maximum(np.abs(low), np.abs(high)) + abs(weight) * at_high)
        return slope, offset + 4 * rounding

    def turns(self, weight: float, slope: float, low: float, high: float) -> set[float]:
        share = slope / weight
        return {math.log(share)} if share > 0 and low < math.log(share) < high else set()

    def stays_above(self, weight: float, slope: float, low: float, high: float) -> bool:
        return math.isfinite(low) and math.isfinite(high)


@singledispatch
def action_of(head: Head, n_outputs: int, output: int) -> Action:
    """Return the bounds of one action of a head that acts by output; raise ValueError for labels."""
    raise no_entry(head, "a proof")


@action_of.register
def _(head: Identity, n_outputs: int, output: int) -> Action:
    return _AffineAction()


@action_of.register
def _(head: Exp, n_outputs: int, output: int) -> Action:
    return _ExpAction()


@action_of.register
def _(head: ClipBox, n_outputs: int, output: int) -> Action:
    return _ClippedAction(*(float(limit[output]) for limit in head.limits(n_outputs)))


@action_of.register
def _(head: TanhBox, n_outputs: int, output: int) -> Action:
    return _TanhAction(*(float(limit[output]) for limit in head.limits(n_outputs)))


@action_of.register(Sign)
@action_of.register(Argmax)
def _(head: Head, n_outputs: int, output: int) -> Action:
    raise _undecided(head)


def require_decided(tree: ObliqueTree) -> None:
    """Raise ValueError if a tree answers labels that none of its tests decide, TypeError if it is no tree."""
    require_tree(tree)
    if tree.head.gives_labels and tree.labels is None:
        raise _undecided(tree.head)


def _undecided(head: Head) -> ValueError:
    return ValueError(
        f"the head is {head!r}, and no test of the tree decides the label; otr.map_network(network) makes a tree whose "
        "leaves have labels, and otr.control.argmax_leaves(tree) one of a tree with the head Argmax"
    )


def tanh_line(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return slope and offset of a line above tanh between low and high (n,), touching it.

    Above 0 tanh is concave: the tangent in the middle. Below it is convex: the chord. Across 0 the line starts at low
    and touches the concave part, or ends at high if that comes first.
    """
    width = np.maximum(high - low, 1e-300)
    near, far = np.maximum(low, 0.0), high.copy()
    for _ in range(60):  # bisection for the point where the tangent passes through (low, tanh low)
        middle = (near + far) / 2
        beyond = (1 - np.tanh(middle) ** 2) * (middle - low) < np.tanh(middle) - np.tanh(low)
        near, far = np.where(beyond, near, middle), np.where(beyond, middle, far)
    chord = (np.tanh(high) - np.tanh(low)) / width
    concave = low >= 0
    touch = np.where(concave, (low + high) / 2, far)
    tangent = 1 - np.tanh(touch) ** 2
    across = ~concave & (high > 0) & (touch < high * (1 - 1e-9))
    slope = np.where(concave | across, tangent, chord)
    through = np.where(concave | across, touch, low)
    # The bisection's point may be off by rounding: lift the line over the end of the interval, too.
    offset = np.tanh(through) - slope * through
    return slope, np.maximum(offset, np.maximum(np.tanh(low) - slope * low, np.tanh(high) - slope * high))
