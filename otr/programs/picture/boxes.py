"""What stands in the boxes of a drawn tree: tests, leaves, and subtrees that are folded up."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import Literal

import numpy as np

from otr.core.arrays import FloatArray, IntArray
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Identity, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.programs.names import label_name

FormulaRow = tuple[str, str] | str  # a number, set flush right, and what it multiplies; or a heading
_EXPONENT_BELOW, _EXPONENT_FROM = -4, 6


@dataclass(frozen=True)
class Style:
    """How formulas are written: names of the inputs and of the answers, significant digits, terms before "more"."""

    features: Sequence[str]
    answers: Sequence[str]
    precision: int
    max_terms: int


@dataclass(frozen=True)
class NodeBox:
    """A box of the picture: a test node, a leaf, or a subtree that is folded up."""

    kind: Literal["test", "leaf", "subtree"]
    title: str  # a line above the rows, such as a label; may be empty
    rows: tuple[FormulaRow, ...]  # lines of a formula
    n_rows: int | None  # rows of data that reach the box; None without counts
    children: tuple[int, ...] = ()  # indices of the boxes on the left and the right, or none
    label: int | None = None


def tree_boxes(tree: ObliqueTree, style: Style, counts: IntArray | None, max_depth: int | None) -> list[NodeBox]:
    """Return the boxes of `tree`, parents before children; the root is box 0.

    `counts` (n_leaves,) are rows of data a leaf. Tests below `max_depth`, if it is given, are folded up, with all
    below.
    """
    n_leaves, n_rows = _sums(tree, np.ones(tree.n_leaves, dtype=np.int64)), _sums(tree, counts)
    boxes: list[NodeBox] = []
    waiting = deque([(0 if tree.n_nodes else ~0, 0)])
    while waiting:
        reference, depth = waiting.popleft()
        reached = n_rows.get(reference)
        if reference < 0:
            boxes.append(_leaf_box(tree, ~reference, style, reached))
        elif max_depth is not None and depth >= max_depth:
            boxes.append(NodeBox("subtree", f"{n_leaves[reference]:,} leaves", (), reached))
        else:
            first = len(boxes) + 1 + len(waiting)
            rows = tuple(rows_of_test(tree.P[reference], float(tree.v[reference]), style))
            boxes.append(NodeBox("test", "", rows, reached, (first, first + 1)))
            waiting.append((int(tree.children_left[reference]), depth + 1))
            waiting.append((int(tree.children_right[reference]), depth + 1))
    return boxes


def rows_of_test(coefficients: FloatArray, offset: float, style: Style) -> list[FormulaRow]:
    """Return the lines of the test ``coefficients @ x + offset <= 0``; a test of one input is solved for it."""
    (used,) = np.nonzero(coefficients)
    if len(used) == 1:
        slope = float(coefficients[used[0]])
        side = "≤" if slope > 0 else "≥"
        return [("", f"{style.features[used[0]]} {side} {number_text(-offset / slope, style.precision)}")]
    rows = affine_rows(coefficients, offset, style)
    if offset or not len(used):
        number, _ = rows.pop()
        return [*rows, (number, "≤ 0")]
    return [*rows, ("", "≤ 0")]


def affine_rows(coefficients: FloatArray, offset: float, style: Style) -> list[tuple[str, str]]:
    """Return the lines of ``coefficients @ x + offset``: the largest terms, how many more there are, the offset."""
    order = np.argsort(-np.abs(coefficients), kind="stable")[: np.count_nonzero(coefficients)].tolist()
    rows = [
        (_signed(float(coefficients[i]), style.precision, first=row == 0), style.features[i])
        for row, i in enumerate(order[: style.max_terms])
    ]
    if len(order) > style.max_terms:
        rows.append(("+", f"{len(order) - style.max_terms:,} more"))
    if offset or not rows:
        rows.append((_signed(offset, style.precision, first=not rows), ""))
    return rows


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


def head_note(tree: ObliqueTree) -> str:
    """Return what the head makes of the leaves' formulas; empty where it makes nothing of them."""
    return "" if tree.labels is not None or not tree.M.any() else note_of(tree.head, tree.n_outputs)


@singledispatch
def note_of(head: Head, n_outputs: int) -> str:
    """Return what a head makes of formulas."""
    raise no_entry(head, "a drawn tree")


@note_of.register
def _(head: Identity, n_outputs: int) -> str:
    return ""


@note_of.register
def _(head: ClipBox, n_outputs: int) -> str:
    return f"formulas are clipped to {_boxes(head, n_outputs)}"


@note_of.register
def _(head: TanhBox, n_outputs: int) -> str:
    return f"formulas go through tanh, scaled to {_boxes(head, n_outputs)}"


@note_of.register
def _(head: PidBox, n_outputs: int) -> str:
    return f"gains times terms go through tanh, scaled to {_boxes(head, n_outputs)}"


@note_of.register
def _(head: Sign, n_outputs: int) -> str:
    return "a formula answers 1 where it is above 0, else 0"


@note_of.register
def _(head: Argmax, n_outputs: int) -> str:
    return "formulas answer which of the outputs is the largest"


def _boxes(head: ClipBox | TanhBox | PidBox, n_outputs: int) -> str:
    """Return the ranges of the answers, each once."""
    limits = zip(*head.limits(n_outputs), strict=True)
    return ", ".join(dict.fromkeys(f"[{number_text(low, 4)}, {number_text(high, 4)}]" for low, high in limits))


def _leaf_box(tree: ObliqueTree, leaf: int, style: Style, n_rows: int | None) -> NodeBox:
    """Return the box of a leaf: its label, its answer where that is the same for all states, or its formulas."""
    if tree.labels is not None:
        label = int(tree.labels[leaf])
        return NodeBox("leaf", label_name(label, style.answers), (), n_rows, label=label)
    if not tree.M[leaf].any():
        answer = np.asarray(tree.head(tree.c[leaf]))
        if answer.ndim == 0:
            return NodeBox("leaf", label_name(int(answer), style.answers), (), n_rows, label=int(answer))
        if len(answer) == 1:
            return NodeBox("leaf", number_text(float(answer[0]), style.precision), (), n_rows)
        values = [number_text(value, style.precision) for value in answer.tolist()]
        return NodeBox("leaf", "", tuple(zip([f"{name} =" for name in style.answers], values, strict=True)), n_rows)
    rows = _output_rows if tree.head.acts_by_output else _gain_rows
    return NodeBox("leaf", "", tuple(rows(tree, leaf, style)), n_rows)


def _output_rows(tree: ObliqueTree, leaf: int, style: Style) -> list[FormulaRow]:
    """Return the lines of a leaf's formulas, output by output."""
    rows: list[FormulaRow] = []
    for output in range(tree.n_outputs):
        if tree.n_outputs > 1:
            rows.append(f"{style.answers[output]} =")
        rows += affine_rows(tree.M[leaf, output], float(tree.c[leaf, output]), style)
    return rows


def _gain_rows(tree: ObliqueTree, leaf: int, style: Style) -> list[FormulaRow]:
    """Return the lines of a PID policy's leaf: a gain and its term each, or that the gain varies with the state."""
    n_actions = tree.head.n_answers(tree.n_outputs)
    n_terms = tree.n_outputs // (n_actions + 1)
    rows: list[FormulaRow] = []
    for action in range(n_actions):
        if n_actions > 1:
            rows.append(f"{style.answers[action]} =")
        for term in range(n_terms):
            gain, (inputs,) = (action + 1) * n_terms + term, np.nonzero(tree.M[leaf, term])
            constant = _signed(float(tree.c[leaf, gain]), style.precision, first=term == 0)
            name = style.features[inputs[0]] if len(inputs) == 1 else f"term {term}"
            rows.append(("θ(s)" if tree.M[leaf, gain].any() else constant, name))
    return rows


def _signed(value: float, precision: int, *, first: bool) -> str:
    text = number_text(value, precision)
    return text if first or value < 0 else f"+{text}"


def _sums(tree: ObliqueTree, values: IntArray | None) -> dict[int, int]:
    """Return the sum of the leaves' values below every reference, a leaf's own included; nothing for None."""
    if values is None:
        return {}
    sums = {~leaf: value for leaf, value in enumerate(values.tolist())}
    for node in reversed(range(tree.n_nodes)):
        sums[node] = sums[int(tree.children_left[node])] + sums[int(tree.children_right[node])]
    return sums
