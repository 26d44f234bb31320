"""Formulas as the lines of a box: the largest terms of tests and of leaves' maps, and numbers to be read."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from otr.core.arrays import FloatArray

FormulaRow = tuple[str, str] | str  # a number, set flush right, and what it multiplies; or a heading
_EXPONENT_BELOW, _EXPONENT_FROM = -4, 6


@dataclass(frozen=True)
class Style:
    """How formulas are written: names of the inputs and of the answers, significant digits, terms before "more".

    Raise ValueError for no digits or no terms.
    """

    features: Sequence[str]
    answers: Sequence[str]
    precision: int
    max_terms: int

    def __post_init__(self) -> None:
        for name in ("precision", "max_terms"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")


def rows_of_test(
    coefficients: FloatArray, offset: float, style: Style, spread: FloatArray | None = None
) -> list[FormulaRow]:
    """Return the lines of the test ``coefficients @ x <= -offset``; a test of one input is solved for it."""
    (used,) = np.nonzero(coefficients)
    if len(used) == 1:
        slope = float(coefficients[used[0]])
        side = "≤" if slope > 0 else "≥"
        return [("", f"{style.features[used[0]]} {side} {number_text(-offset / slope, style.precision)}")]
    if not len(used):
        return [("", f"{number_text(offset, style.precision)} ≤ 0")]
    rows = affine_rows(coefficients, 0.0, style, spread)
    left_out = len(used) > style.max_terms
    if left_out:
        rows.pop()
    side = f"≤ {number_text(-offset, style.precision)}"
    return [*rows, ("+ …" if left_out else "", side)]


def affine_rows(
    coefficients: FloatArray, offset: float, style: Style, spread: FloatArray | None = None
) -> list[tuple[str, str]]:
    """Return the lines of ``coefficients @ x + offset``: the largest terms, how many more there are, the offset."""
    order = largest_terms(coefficients, spread)
    rows = [
        (signed(float(coefficients[i]), style.precision, first=row == 0), style.features[i])
        for row, i in enumerate(order[: style.max_terms])
    ]
    if len(order) > style.max_terms:
        rows.append(("+", f"{len(order) - style.max_terms:,} more"))
    if offset or not rows:
        rows.append((signed(offset, style.precision, first=not rows), ""))
    return rows


def largest_terms(coefficients: FloatArray, spread: FloatArray | None) -> list[int]:
    """Return the inputs that are read, the largest coefficient first, in units of the inputs' spread if it is known."""
    sizes = np.abs(coefficients) * (1.0 if spread is None else spread)
    order = np.lexsort((-np.abs(coefficients), -sizes))
    return [int(i) for i in order if coefficients[i] != 0]


def signed(value: float, precision: int, *, first: bool) -> str:
    """Return a number with its sign, a plus left out where it comes first."""
    text = number_text(value, precision)
    return text if first or value < 0 else f"+{text}"


def number_text(value: float, precision: int) -> str:
    """Return a number to so many significant digits, 114 rather than 1.1e+02, with a real minus sign."""
    if value == 0 or not math.isfinite(value):  # a threshold, offset / slope, may overflow
        return f"{abs(value) if value == 0 else value:g}".replace("-", "−")
    size = math.floor(math.log10(abs(value)))
    if _EXPONENT_BELOW <= size < _EXPONENT_FROM:
        text = f"{value:.{max(0, precision - 1 - size)}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
    else:
        text = f"{value:.{precision}g}"
    return text.replace("-", "−")


def joined(rows: Sequence[FormulaRow]) -> str:
    """Return lines as one, signs apart from their numbers."""
    words = [row if isinstance(row, str) else " ".join(part for part in row if part) for row in rows]
    text = " ".join(words)
    return re.sub(r"(?<=[^≤≥=] )([+−])(?=[\d.])", r"\1 ", text)
