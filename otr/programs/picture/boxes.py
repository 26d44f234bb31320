"""What is in the boxes of a drawn tree: tests, leaves, and subtrees that are folded up."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray, IntArray, as_batch
from otr.core.tree import ObliqueTree
from otr.programs.names import label_name
from otr.programs.picture.formulas import (
    FormulaRow,
    Style,
    affine_rows,
    joined,
    largest_terms,
    number_text,
    rows_of_test,
    signed,
)

MOST_FORMULAS = 2  # outputs whose formulas a leaf shows; of more, it shows their means over the states, or main terms
MOST_OUTPUTS = 4  # of these that a leaf names


@dataclass(frozen=True)
class Visits:
    """What a tree does in states."""

    counts: IntArray  # (n_leaves,) states that end there
    means: FloatArray  # (n_leaves, n_answers), of their answers; NaN of labels, and where there are none
    spread: FloatArray  # (d,), the inputs' standard deviations


@dataclass(frozen=True)
class NodeBox:
    """A box of the picture: a test node, a leaf, or a subtree that is folded up."""

    kind: Literal["test", "leaf", "subtree"]
    title: str  # a line above the rows, such as a label; may be empty
    rows: tuple[FormulaRow, ...]  # lines of a formula
    n_rows: int | None  # states that reach the box; None without states
    children: tuple[int, ...] = ()  # indices of the boxes on the left and the right, or none
    label: int | None = None
    levels: tuple[float, ...] = ()  # the answers between -1, the lowest, and 1, the highest; empty where unknown
    shorter: tuple[str, ...] = ()  # the same in one line, ever shorter
    hint: str = ""  # all terms, in one line


def visits_of(tree: ObliqueTree, X: ArrayLike) -> Visits:
    """Return what the tree does in the states X (n, d)."""
    states = as_batch(X, tree.n_inputs)
    leaves, answers = tree.apply(states), np.asarray(tree.predict(states))
    counts = np.bincount(leaves, minlength=tree.n_leaves)
    means = np.full((tree.n_leaves, 1 if answers.ndim == 1 else answers.shape[1]), np.nan)
    if answers.ndim == 2:
        sums = np.zeros_like(means)
        np.add.at(sums, leaves, answers)
        np.divide(sums, counts[:, None], out=means, where=counts[:, None] > 0)
    return Visits(counts, means, states.std(axis=0) if len(states) else np.ones(tree.n_inputs))


def tree_boxes(tree: ObliqueTree, style: Style, visits: Visits | None, max_depth: int | None) -> list[NodeBox]:
    """Return the boxes of `tree`, parents before children; the root is box 0.

    Tests below `max_depth`, if it is given, are folded up, with all below. Raise ValueError if it is negative.
    """
    if max_depth is not None and max_depth < 0:
        raise ValueError(f"max_depth is {max_depth}, expected at least 0")
    n_leaves = _sums(tree, np.ones(tree.n_leaves, dtype=np.int64))
    n_rows = _sums(tree, visits.counts if visits else None)
    answers = _answers(tree, visits)
    levels = _levels(tree, answers)
    boxes: list[NodeBox] = []
    waiting = deque([(0 if tree.n_nodes else ~0, 0)])
    while waiting:
        reference, depth = waiting.popleft()
        reached = n_rows.get(reference)
        if reference < 0:
            boxes.append(_leaf_box(tree, ~reference, style, visits, answers[~reference], levels[~reference], reached))
        elif max_depth is not None and depth >= max_depth:
            title = f"{n_leaves[reference]:,} leaves"
            boxes.append(
                NodeBox("subtree", title, (), reached, shorter=(title, f"{n_leaves[reference]:,}"), hint=title)
            )
        else:
            first = len(boxes) + 1 + len(waiting)
            boxes.append(_test_box(tree.P[reference], float(tree.v[reference]), style, visits, reached, first))
            waiting.append((int(tree.children_left[reference]), depth + 1))
            waiting.append((int(tree.children_right[reference]), depth + 1))
    return boxes


def _test_box(
    coefficients: FloatArray, offset: float, style: Style, visits: Visits | None, n_rows: int | None, first: int
) -> NodeBox:
    spread = None if visits is None else visits.spread
    rows = tuple(rows_of_test(coefficients, offset, style, spread))
    n_terms = np.count_nonzero(coefficients)
    shorter = tuple(
        joined(rows_of_test(coefficients, offset, replace(style, max_terms=n), spread))
        for n in range(min(style.max_terms, int(n_terms)), 0, -1)
    )
    name = [style.features[i] for i in largest_terms(coefficients, spread)[:1]]
    hint = joined(rows_of_test(coefficients, offset, replace(style, max_terms=len(coefficients)), spread))
    return NodeBox("test", "", rows, n_rows, (first, first + 1), shorter=(*shorter, *name), hint=hint)


def _answers(tree: ObliqueTree, visits: Visits | None) -> FloatArray:
    """Return the leaves' answers (n_leaves, n_answers): constant, or means over the states; NaN where unknown."""
    known = np.full((tree.n_leaves, tree.head.n_answers(tree.n_outputs)), np.nan)
    if tree.labels is not None or tree.head.gives_labels:
        return known
    if visits is not None:
        known = visits.means.copy()
    constant = ~tree.M.any(axis=(1, 2))
    if constant.any():
        known[constant] = tree.head(tree.c[constant])
    return known


def _levels(tree: ObliqueTree, answers: FloatArray) -> list[tuple[float, ...]]:
    """Return a leaf's answers between -1 and 1: in the head's limits, or in units of the tree's largest answer."""
    limits = tree.head.limits(tree.n_outputs)
    if limits is None:
        largest = np.nanmax(np.abs(answers), axis=0, initial=0.0, where=np.isfinite(answers))
        limits = -largest, largest
    half = (limits[1] - limits[0]) / 2
    scaled = (answers - (limits[1] + limits[0]) / 2) / np.where(half > 0, half, 1.0)
    return [tuple(map(float, row)) if np.isfinite(row).all() else () for row in scaled]


def _leaf_box(
    tree: ObliqueTree, leaf: int, style: Style, visits: Visits | None, answer: FloatArray, levels: tuple[float, ...],
    n_rows: int | None,
) -> NodeBox:  # fmt: skip
    """Return the box of a leaf: its label, its answer where that is the same for all states, or its formulas."""
    is_constant = not tree.M[leaf].any()
    label = None if tree.labels is None else int(tree.labels[leaf])
    if label is None and tree.head.gives_labels and is_constant:
        label = int(tree.head(tree.c[leaf]))
    if label is not None:
        name = label_name(label, style.answers)
        return NodeBox("leaf", name, (), n_rows, label=label, shorter=(name,), hint=name)
    spread = None if visits is None else visits.spread
    hint = joined(_output_rows(tree, leaf, replace(style, max_terms=tree.n_inputs), spread))
    numbers = [number_text(value, style.precision) for value in answer.tolist()] if levels else []
    title, rows = "", _formula_rows(tree, leaf, style, spread)
    if len(numbers) == 1:
        title, rows = (numbers[0], []) if is_constant else (f"mean {numbers[0]}", rows)
    elif numbers and (len(numbers) > MOST_FORMULAS or is_constant):
        rows = _strongest(numbers, levels, style)
    shorter = _in_one_line(numbers, levels, style) if numbers else (joined(rows), joined(rows[:1]) + " …")
    return NodeBox("leaf", title, tuple(rows), n_rows, levels=levels, shorter=shorter, hint=hint)


def _strongest(numbers: Sequence[str], levels: Sequence[float], style: Style) -> list[FormulaRow]:
    """Return the lines of the outputs that are furthest from the middle of their range, in the outputs' order."""
    order = sorted(range(len(numbers)), key=lambda i: -abs(levels[i]))
    shown = sorted(order[:MOST_OUTPUTS])
    rows: list[FormulaRow] = [(numbers[i], style.answers[i]) for i in shown]
    return [*rows, ("+", f"{len(order) - len(shown)} more")] if len(order) > len(shown) else rows


def _in_one_line(numbers: Sequence[str], levels: Sequence[float], style: Style) -> tuple[str, ...]:
    """Return what the outputs are in one line, the strongest first: all of them, and ever fewer."""
    order = sorted(range(len(numbers)), key=lambda i: -abs(levels[i]))
    named = [f"{style.answers[i]} {numbers[i]}" for i in order]
    lines = [", ".join(named[:n]) + ("" if n == len(named) else ", …") for n in range(len(named), 0, -1)]
    return (*lines, *numbers) if len(numbers) == 1 else tuple(lines)


def _formula_rows(tree: ObliqueTree, leaf: int, style: Style, spread: FloatArray | None) -> list[FormulaRow]:
    """Return the lines of a leaf's formulas: of few outputs, of a PID policy's gains, or each output's main term."""
    if not tree.head.acts_by_output:
        return _gain_rows(tree, leaf, style)
    few = len(style.answers) <= MOST_FORMULAS
    return (_output_rows if few else _main_terms)(tree, leaf, style, spread)


def _main_terms(tree: ObliqueTree, leaf: int, style: Style, spread: FloatArray | None) -> list[FormulaRow]:
    """Return a line for each output, with the largest term of its formula."""
    rows: list[FormulaRow] = []
    for output, name in enumerate(style.answers[:MOST_OUTPUTS]):
        terms = affine_rows(tree.M[leaf, output], float(tree.c[leaf, output]), replace(style, max_terms=1), spread)
        rows.append((f"{name} =", " ".join(terms[0]).strip() + (" + …" if len(terms) > 1 else "")))
    n_more = len(style.answers) - len(rows)
    return [*rows, ("+", f"{n_more} more")] if n_more else rows


def _output_rows(tree: ObliqueTree, leaf: int, style: Style, spread: FloatArray | None) -> list[FormulaRow]:
    """Return the lines of a leaf's formulas, output by output."""
    rows: list[FormulaRow] = []
    for output in range(tree.n_outputs):
        if tree.n_outputs > 1:
            rows.append(f"{style.answers[output] if tree.head.acts_by_output else f'y{output}'} =")
        rows += affine_rows(tree.M[leaf, output], float(tree.c[leaf, output]), style, spread)
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
            constant = signed(float(tree.c[leaf, gain]), style.precision, first=term == 0)
            name = style.features[inputs[0]] if len(inputs) == 1 else f"term {term}"
            rows.append(("θ(s)" if tree.M[leaf, gain].any() else constant, name))
    return rows


def _sums(tree: ObliqueTree, values: IntArray | None) -> dict[int, int]:
    """Return the sum of the leaves' values below every reference, a leaf's own included; nothing for None."""
    if values is None:
        return {}
    sums = {~leaf: value for leaf, value in enumerate(values.tolist())}
    for node in reversed(range(tree.n_nodes)):
        sums[node] = sums[int(tree.children_left[node])] + sums[int(tree.children_right[node])]
    return sums


def share_text(box: NodeBox, root: NodeBox) -> str:
    """Return the share of the states that reach a box; empty without states."""
    if box.n_rows is None or not root.n_rows:
        return ""
    share = box.n_rows / root.n_rows
    if not box.n_rows:
        return "never"
    if share < 0.001:
        return "< 0.1 %"
    return f"{100 * share:.{0 if share >= 0.1 else 1}f} %"
