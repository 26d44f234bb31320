"""A tree as the nested if-then-else program in which the thesis prints its policies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Argmax, ClipBox, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.programs.language.tokens import written
from otr.programs.names import names_of
from otr.programs.pid_gains import control_text, gain_lines, term_lines

__all__ = ["affine_text", "to_text"]

_INDENT = "    "


def to_text(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 4,
) -> str:
    """Return the program of `tree`, as in Orfanos 2023, Fig. 4.2.

        if -2.2 - 3.8 x + 114.3 v <= 0 then
            return -6.1
        else
            return -102.3 - 169.8 x + 5116.5 v

    Several outputs take one line each, ``name = expression``. Coefficients that are zero are left out. A PID policy's
    leaf states its gains first (`otr.PidBox`), as in Fig. 4.4; what P, I and D are stands above the program. A name
    that is not made of words stands between backquotes, where `parse_program` reads it back whatever it holds.

    Args:
        tree: any tree.
        feature_names: d names; x0, x1, ... if None.
        output_names: names of the outputs, y0, y1, ... if None; in a tree with labels, names of the labels.
        precision: significant digits, at least 1; 17 loses nothing.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, precision < 1, or a PID policy whose terms differ between leaves.
    """
    if not isinstance(tree, ObliqueTree):
        raise TypeError(f"tree is a {type(tree).__name__}, expected an ObliqueTree; a PatternTree has to_tree()")
    if precision < 1:
        raise ValueError(f"precision is {precision}, expected at least 1 significant digit")
    features, answers = names_of(tree, feature_names, output_names)
    features = [written(name) for name in features]
    is_number = [tree.labels is not None and name == str(label) for label, name in enumerate(answers)]
    answers = [name if own else written(name) for name, own in zip(answers, is_number, strict=True)]
    is_pid = isinstance(tree.head, PidBox)
    lines = term_lines(tree, lambda row, offset: affine_text(row, offset, features, precision)) if is_pid else []
    # What is still to be written, last first: (indentation, a line) or (indentation, a reference to a child).
    pending: list[tuple[int, str | int]] = [(0, 0 if tree.n_nodes else ~0)]
    while pending:
        indent, item = pending.pop()
        if isinstance(item, str):
            lines.append(_INDENT * indent + item)
        elif item < 0:
            lines += [_INDENT * indent + line for line in _leaf_lines(tree, ~item, features, answers, precision)]
        else:
            test = affine_text(tree.P[item], tree.v[item], features, precision)
            lines.append(f"{_INDENT * indent}if {test} <= 0 then")
            pending.append((indent + 1, int(tree.children_right[item])))
            pending.append((indent, "else"))
            pending.append((indent + 1, int(tree.children_left[item])))
    return "\n".join(lines) + "\n"


def affine_text(coefficients: FloatArray, offset: float, names: Sequence[str], precision: int) -> str:
    """Return ``offset + coefficients @ names`` as text, constant first, zeros left out."""
    terms = [] if offset == 0 else [(float(offset), "")]
    terms += [(float(coefficients[i]), names[i]) for i in np.flatnonzero(coefficients).tolist()]
    if not terms:
        return "0"
    text = ""
    for position, (value, name) in enumerate(terms):
        size = f"{abs(value):.{precision}g}"
        word = name if name and size == "1" else f"{size} {name}".rstrip()
        sign = ("-" if value < 0 else "") if position == 0 else (" - " if value < 0 else " + ")
        text += sign + word
    return text


def _leaf_lines(
    tree: ObliqueTree, leaf: int, features: Sequence[str], answers: Sequence[str], precision: int
) -> list[str]:
    """Return the lines that state a leaf's answer."""
    if tree.labels is not None:
        label = int(tree.labels[leaf])
        return [f"return {answers[label] if 0 <= label < len(answers) else label}"]
    if isinstance(tree.head, PidBox):
        gains = gain_lines(tree, leaf, answers, lambda row, offset: affine_text(row, offset, features, precision))
        controls = [control_text(answers, action) for action in range(len(answers))]
        return [*gains, *_answer_lines(tree, controls, answers, precision)]
    values = [
        affine_text(tree.M[leaf, output], tree.c[leaf, output], features, precision) for output in range(tree.n_outputs)
    ]
    if isinstance(tree.head, Sign):
        return [f"return 1 if {values[0]} > 0 else 0"]
    if isinstance(tree.head, Argmax):
        assignments = [f"{name} = {value}" for name, value in zip(answers, values, strict=True)]
        return [*assignments, f"return argmax({', '.join(answers)})"]
    return _answer_lines(tree, values, answers, precision)


def _answer_lines(tree: ObliqueTree, values: Sequence[str], answers: Sequence[str], precision: int) -> list[str]:
    """Return the lines of continuous answers, from the text of each before the head."""
    values = [_through_head(tree, answer, value, precision) for answer, value in enumerate(values)]
    if len(values) == 1:
        return [f"return {values[0]}"]
    return [f"{name} = {value}" for name, value in zip(answers, values, strict=True)]


def _through_head(tree: ObliqueTree, answer: int, value: str, precision: int) -> str:
    """Return the expression of one answer with a box head around it."""
    head = tree.head
    if not isinstance(head, TanhBox | ClipBox | PidBox):
        return value
    n_answers = head.n_answers(tree.n_outputs)
    low, high = (float(np.broadcast_to(limit, (n_answers,))[answer]) for limit in (head.low, head.high))
    if isinstance(head, ClipBox):
        return f"clip({value}, {low:.{precision}g}, {high:.{precision}g})"
    half, middle = (high - low) / 2, (high + low) / 2
    return affine_text(np.array([half]), middle, [f"tanh({value})"], precision)
