"""Lines above a head's answer: an action weighed by a number, bounded by an affine function of its output."""

from __future__ import annotations

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import ClipBox, Head, TanhBox

__all__ = ["half_and_middle", "limits_of_head", "line_above", "tanh_line"]


def limits_of_head(head: Head, n_outputs: int, output: int) -> tuple[float, float]:
    assert isinstance(head, ClipBox | TanhBox)
    low, high = (np.broadcast_to(limit, (n_outputs,)) for limit in (head.low, head.high))
    return float(low[output]), float(high[output])


def half_and_middle(head: Head, n_outputs: int, output: int) -> tuple[float, float]:
    low, high = limits_of_head(head, n_outputs, output)
    return (high - low) / 2, (high + low) / 2


def line_above(
    head: Head, n_outputs: int, output: int, weight: float, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return slope and offset of a line in y that is nowhere below ``weight * head(y)`` between low and high (n,)."""
    n = len(low)
    if isinstance(head, ClipBox):
        bottom, top = limits_of_head(head, n_outputs, output)
        inside = np.isfinite(low) & np.isfinite(high)
        constant = np.where(np.isfinite(high), bottom, top)
        return np.where(inside, weight, 0.0), np.where(inside, 0.0, weight * constant)
    if not isinstance(head, TanhBox):
        return np.full(n, weight), np.zeros(n)
    half, middle = half_and_middle(head, n_outputs, output)
    if weight < 0:  # weight tanh(y) = -weight tanh(-y)
        slope, offset = tanh_line(-high, -low)
        slope = -slope
    else:
        slope, offset = tanh_line(low, high)
    scale = abs(weight) * half
    return scale * slope, scale * offset + weight * middle


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
