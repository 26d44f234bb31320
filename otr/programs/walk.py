"""What several program formats share: the walk over a tree, rows that are stored once, affine expressions."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray, IntArray
from otr.core.tree import ObliqueTree

# Ifs are nested up to this depth; Python's parser allows 100 indentations.
MAX_NESTED_DEPTH = 64
WIDTH = 110  # of a line of code
TIE = "\u00a0"  # a space at which `wrapped` breaks no line


def summary_of(tree: ObliqueTree) -> str:
    """Return what a program's first line says of the tree."""
    leaves = "1 leaf" if tree.n_leaves == 1 else f"{tree.n_leaves:,} leaves"
    return f"an oblique decision tree of depth {tree.depth} with {leaves}"


def walk(tree: ObliqueTree) -> Iterator[tuple[Literal["if", "else", "end", "leaf"], int, int]]:
    """Yield (what, node or leaf, depth) in the order in which nested ifs are written, however deep the tree is."""
    pending: list[tuple[Literal["if", "else", "end", "leaf"], int, int]] = [_event(0 if tree.n_nodes else ~0, 0)]
    while pending:
        what, index, depth = pending.pop()
        yield what, index, depth
        if what == "if":
            pending.append(("end", index, depth))
            pending.append(_event(int(tree.children_right[index]), depth + 1))
            pending.append(("else", index, depth))
            pending.append(_event(int(tree.children_left[index]), depth + 1))


def in_printed_order(tree: ObliqueTree) -> ObliqueTree:
    """Return the tree with its leaves numbered as programs print and pictures draw them, from the top."""
    order = np.array([leaf for what, leaf, _ in walk(tree) if what == "leaf"])
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    sides = {
        name: np.where(side >= 0, side, ~number[np.where(side < 0, ~side, 0)])
        for name, side in (("children_left", tree.children_left), ("children_right", tree.children_right))
    }
    labels = None if tree.labels is None else tree.labels[order]
    return tree.replace(**sides, M=tree.M[order], P=tree.P, c=tree.c[order], labels=labels)


def _event(reference: int, depth: int) -> tuple[Literal["if", "leaf"], int, int]:
    return ("if", reference, depth) if reference >= 0 else ("leaf", ~reference, depth)


def child(tree: ObliqueTree) -> IntArray:
    """Return the references of the children, (n_nodes, 2): left, right."""
    return np.stack((tree.children_left, tree.children_right), axis=1)


def distinct_rows(rows: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct rows in the order in which they first occur, and for each row which of them it is."""
    return _distinct(rows)


def distinct_integers(rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return what `distinct_rows` does, of integers."""
    return _distinct(rows)


def _distinct(rows: NDArray[Any]) -> tuple[NDArray[Any], IntArray]:
    unique, first, index = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return unique[order], rank[index.reshape(-1)]


def require_float_rows(rows: FloatArray) -> None:
    """Raise ValueError if a row of weights (n, m), which decides by its sign, would be lost in single precision."""
    largest = np.abs(rows).max(axis=1, initial=0.0)
    lost = largest[(largest > 0) & (largest < np.finfo(np.float32).tiny)]
    if len(lost):
        raise ValueError(
            f"the policy has a test, or a unit, whose largest weight is {lost[0]:.6g}, too small for a float; use "
            "dtype='double'"
        )


def affine_expression(
    coefficients: FloatArray,
    offset: float,
    names: Sequence[str],
    number: Callable[[float], str],
    *,
    times: str = f"{TIE}*{TIE}",
    tie: str = TIE,
    leaves_out_ones: bool = False,
) -> str:
    """Return ``offset + coefficient * name - ...``, by default in the notation of most languages; without zeros.

    `number` writes a number that is not negative; `times` goes between a coefficient and its name, `tie` between a
    sign and its term, by default with spaces at which no line is broken. With `leaves_out_ones` a coefficient that is
    written as 1 is left out.
    """
    terms = [] if offset == 0 else [(float(offset), "")]
    terms += [(float(coefficients[i]), names[i]) for i in np.flatnonzero(coefficients).tolist()]
    text = ""
    for position, (value, name) in enumerate(terms):
        size = number(abs(value))
        term = size if not name else name if leaves_out_ones and size == "1" else f"{size}{times}{name}"
        sign = "-" if value < 0 else "+" if position else ""
        text += f" {sign}{tie}{term}" if position else f"{sign}{term}"
    return text or number(0.0)


def wrapped(text: str, indent: str) -> list[str]:
    """Return code as lines of at most WIDTH, broken at spaces, the further ones indented by eight more."""
    lines = textwrap.wrap(
        text,
        width=max(WIDTH, len(indent) + 60),
        initial_indent=indent,
        subsequent_indent=f"{indent}        ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(TIE, " ") for line in lines]
