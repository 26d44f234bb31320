"""What a picture consists of, in points (1/72 inch): boxes, branches and words; x grows to the right and y downwards.

A picture is laid out once, as a `Scene`, and written as SVG (`svg.py`) or by matplotlib (`drawing.py`).
"""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from typing import Literal

INK, FAINT = "#1a1a1a", "#5b6570"


@dataclass(frozen=True)
class Box:
    """A filled rectangle; `hint` is what a reader sees who points at it."""

    x: float
    y: float
    width: float
    height: float
    fill: str
    line: str = "none"
    radius: float = 0.0
    dashed: bool = False
    hint: str = ""


@dataclass(frozen=True)
class Branch:
    """A curve from left to right, level at both ends."""

    x: float
    y: float
    to_x: float
    to_y: float
    width: float
    colour: str


@dataclass(frozen=True)
class Words:
    """A line of text; y is its baseline."""

    x: float
    y: float
    text: str
    size: float
    align: Literal["start", "middle", "end"] = "start"
    bold: bool = False
    colour: str = INK


@dataclass(frozen=True)
class Scene:
    """A picture, in the order in which it is drawn."""

    width: float
    height: float
    title: str
    items: tuple[Box | Branch | Words, ...]


_CHARACTERS = "".join(map(chr, range(32, 127))) + "−≤≥…·±θ×°"
# Hundredths of the font's size, of DejaVu Sans: Verdana's are the same, Arial's and Helvetica's less.
_NORMAL = (
    32, 40, 46, 84, 64, 95, 78, 27, 39, 39, 50, 84, 32, 36, 32, 34, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 34, 34,
    84, 84, 84, 53, 100, 68, 69, 70, 77, 63, 58, 77, 75, 30, 30, 66, 56, 86, 75, 79, 60, 79, 69, 63, 61, 73, 68, 99,
    68, 61, 68, 39, 34, 39, 84, 50, 50, 61, 63, 55, 63, 62, 35, 63, 63, 28, 28, 58, 28, 97, 63, 61, 63, 63, 41, 52,
    39, 63, 59, 82, 59, 59, 52, 64, 34, 64, 84, 84, 84, 84, 100, 32, 84, 61, 84, 50,
)  # fmt: skip
_BOLD = (
    35, 46, 52, 84, 70, 100, 87, 31, 46, 46, 52, 84, 38, 42, 38, 37, 70, 70, 70, 70, 70, 70, 70, 70, 70, 70, 40, 40,
    84, 84, 84, 58, 100, 77, 76, 73, 83, 68, 68, 82, 84, 37, 37, 77, 64, 100, 84, 85, 73, 85, 77, 72, 68, 81, 77,
    110, 77, 72, 73, 46, 37, 46, 84, 50, 50, 67, 72, 59, 72, 68, 44, 72, 71, 34, 34, 66, 34, 104, 71, 69, 72, 72,
    49, 60, 48, 71, 65, 92, 64, 65, 58, 71, 37, 71, 84, 84, 84, 84, 100, 38, 84, 69, 84, 50,
)  # fmt: skip
_WIDTHS = {False: dict(zip(_CHARACTERS, _NORMAL, strict=True)), True: dict(zip(_CHARACTERS, _BOLD, strict=True))}


def text_width(text: str, size: float, *, bold: bool = False) -> float:
    """Return how wide a line of text is, in points."""
    widths = _WIDTHS[bold]
    return sum(widths.get(letter) or _width_of_other(letter) for letter in text) * size / 100


def _width_of_other(letter: str) -> int:
    """Return a width that is rather too large for a letter that is not in the table."""
    if unicodedata.combining(letter):
        return 0
    return 100 if unicodedata.east_asian_width(letter) in "WF" else 85
