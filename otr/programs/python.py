"""A tree as one stand-alone Python function, which needs nothing but the standard library."""

from __future__ import annotations

import keyword
import unicodedata
from collections.abc import Sequence
from functools import singledispatch

import numpy as np

from otr.core.fixed_point.tree import FixedPointTree
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.programs.fixed_point_python import fixed_point_python
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import Names, check_tree, give_labels, label_name, names_for
from otr.programs.pid_gains import joined
from otr.programs.walk import (
    MAX_NESTED_DEPTH,
    TIE,
    WIDTH,
    affine_expression,
    child,
    distinct_rows,
    summary_of,
    walk,
    wrapped,
)

# A sum is parsed and compiled by recursion over its terms.
MAX_TERMS = 200
_LARGEST_EXPONENT = 709.782712893384  # math.exp raises OverflowError above it, where numpy's is inf
_CALLED = ("exp", "tanh", "min", "max", "map", "float", "abs", "int", "len", "range")
_RESERVED = (*keyword.kwlist, *_CALLED, "state", "outputs")
_INDENT = "    "


def to_python(
    tree: ObliqueTree | FixedPointTree,
    *,
    name: str = "policy",
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> str:
    """Return a Python module with the one function ``name(state)`` that answers as ``tree.predict(state)`` does.

    The function takes d numbers and returns the list of the answer's numbers or, where the answers are labels, an int.
    It computes with Python's floats, of 64 bits, also where it is given numbers of numpy's float32. It is written as
    nested ifs. A tree that is deeper than Python's parser bears, or that reads hundreds of inputs at once, is written
    as tables and a loop. Numbers are written in their shortest exact form.

    A `FixedPointTree` becomes a module of integers alone, which MicroPython runs, too, and answers as
    ``predict_integers``.

    Args:
        tree: any tree.
        name: what to call the function.
        feature_names, output_names: as in `to_text`; they become variables.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, names that are not distinct, or `name` is no identifier or one of the
            functions that are called.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> scope = {}
        >>> exec(otr.to_python(tree), scope)
        >>> scope["policy"]([-3.0])
        [3.0]
    """
    read = unicodedata.normalize("NFKC", name)  # as Python reads an identifier
    if not name.isidentifier() or keyword.iskeyword(read) or read in (*_CALLED, "__debug__"):
        raise ValueError(f"name is {name!r}, which cannot be the name of the Python function")
    if isinstance(tree, FixedPointTree):
        return fixed_point_python(tree, name, feature_names, output_names)
    check_tree(tree)
    tree = merge_equal_leaves(tree)
    names = names_for(tree, feature_names, output_names, reserved=(*_RESERVED, name))
    n_terms = max(np.count_nonzero(tree.P, axis=1).max(initial=0), np.count_nonzero(tree.M, axis=2).max())
    nested = tree.depth <= MAX_NESTED_DEPTH and n_terms <= MAX_TERMS
    body, imports = _nested(tree, names) if nested else _tables(tree), list[str]()
    if tree.labels is None:
        outputs = names.output_ids if nested else [f"outputs[{i}]" for i in range(tree.n_outputs)]
        answer = answer_lines(tree.head, outputs, names)
        called = next((word for word in ("exp", "tanh") if any(f"{word}(" in line for line in answer)), None)
        imports = [f"from math import {called}", ""] if called else []
        body += answer
    # Python looks for a declaration of the file's encoding in comments on the first two lines: no name goes there.
    what = summary_of(tree)
    lines = [f"# {what[0].upper()}{what[1:]}.", "# It needs nothing but the standard library.", "#"]
    lines += _interface(tree, names)
    lines += [*imports, "", f"def {name}(state):", *(_INDENT + line if line else "" for line in body)]
    return "\n".join(lines) + "\n"


def _interface(tree: ObliqueTree, names: Names) -> list[str]:
    lines = [
        f"# state[{i}]: {identifier}{_original(name, identifier)}"
        for i, (name, identifier) in enumerate(zip(names.features, names.feature_ids, strict=True))
    ]
    if give_labels(tree):
        return [*lines, "# The answer is the number of a label.", ""]
    answers = zip(names.answers, names.answer_ids, strict=True)
    what = ", ".join(f"{identifier}{_original(name, identifier)}" for name, identifier in answers)
    return [*lines, f"# The answer is the list of: {what}", ""]


def _original(name: str, identifier: str) -> str:
    return "" if name == identifier else f' ("{name}")'


def _nested(tree: ObliqueTree, names: Names) -> list[str]:
    """Return nested ifs that assign the outputs, or return the label."""
    features = names.feature_ids
    lines = _statement("", f"{', '.join(features)}{',' * (len(features) == 1)}", " = map(float, state)", "")
    for what, index, depth in walk(tree):
        indent = _INDENT * depth
        if what == "if":
            test = affine_expression(tree.P[index], float(tree.v[index]), features, repr)
            lines += _statement("if ", test, " <= 0:", indent)
        elif what == "else":
            lines.append(f"{indent}else:")
        elif what == "leaf" and tree.labels is not None:
            label = int(tree.labels[index])
            lines.append(f"{indent}return {label}{_label_comment(label, names)}")
        elif what == "leaf":
            for output, identifier in enumerate(names.output_ids):
                value = affine_expression(tree.M[index, output], float(tree.c[index, output]), features, repr)
                lines += _statement(f"{identifier} = ", value, "", indent)
    return lines


def _statement(before: str, expression: str, after: str, indent: str) -> list[str]:
    """Return a statement in one line, or in several where that is too long: then its expression is in brackets.

    Only within these a line ends: however long a name is, what is around the brackets stays on their lines.
    """
    fits = len(indent + before + expression + after) <= WIDTH
    inner = expression if fits else f"({expression})"
    return wrapped(f"{before.replace(' ', TIE)}{inner}{after.replace(' ', TIE)}", indent)


def _label_comment(label: int, names: Names) -> str:
    name = label_name(label, names.answers)
    return "" if name == str(label) else f"  # {name}"


def _tables(tree: ObliqueTree) -> list[str]:
    """Return tables, a loop that finds the leaf, and what assigns `outputs` or returns the label."""
    lines = ["state = [*map(float, state)]"]
    if tree.n_nodes:
        tests, test_of_node = distinct_rows(tree.test_forms)
        lines += [
            "# A test's offset, and its weights by input; a negative child r is the leaf ~r.",
            f"tests = {_rows(tests)}",
            f"test_of = {_tuple(test_of_node)}",
            f"children = ({', '.join(_tuple(pair) for pair in child(tree))},)",
            "node = 0",
            "while node >= 0:",
            "    offset, weights = tests[test_of[node]]",
            "    for i, w in weights:",
            "        offset += w * state[i]",
            "    node = children[node][1 if offset > 0 else 0]",
        ]
    else:
        lines.append("node = -1")
    if tree.labels is not None:
        return [*lines, f"return {_tuple(tree.labels)}[~node]"]
    rows, row_of = distinct_rows(tree.leaf_forms.reshape(-1, tree.n_inputs + 1))
    of_leaf = row_of.reshape(tree.n_leaves, tree.n_outputs)
    return [
        *lines,
        f"rows = {_rows(rows)}",
        f"rows_of = ({', '.join(_tuple(of) for of in of_leaf)},)",
        "outputs = []",
        "for row in rows_of[~node]:",
        "    offset, weights = rows[row]",
        "    for i, w in weights:",
        "        offset += w * state[i]",
        "    outputs.append(offset)",
    ]


def _rows(rows: np.ndarray) -> str:
    """Return rows of coefficients and an offset as ((offset, ((column, coefficient), ...)), ...)."""
    written = []
    for row in rows:
        weights = [f"({i}, {float(row[i])!r})" for i in np.flatnonzero(row[:-1]).tolist()]
        written.append(f"({float(row[-1])!r}, ({''.join(f'{weight}, ' for weight in weights).rstrip(' ')}))")
    return f"({', '.join(written)},)"


def _tuple(values: np.ndarray) -> str:
    return f"({', '.join(str(value) for value in values.tolist())},)"


@singledispatch
def answer_lines(head: Head, outputs: Sequence[str], names: Names) -> list[str]:
    """Return the lines that make the answer under a head of the outputs, which are variables or items of a list."""
    raise no_entry(head, "to_python")


@answer_lines.register
def _(head: Identity, outputs: Sequence[str], names: Names) -> list[str]:
    return [_returned(outputs)]


@answer_lines.register
def _(head: Exp, outputs: Sequence[str], names: Names) -> list[str]:
    return [_returned([f'float("inf") if {value} > {_LARGEST_EXPONENT!r} else exp({value})' for value in outputs])]


@answer_lines.register
def _(head: ClipBox, outputs: Sequence[str], names: Names) -> list[str]:
    limits = zip(outputs, *(limit.tolist() for limit in head.limits(len(outputs))), strict=True)
    return [_returned([f"min(max({value}, {low!r}), {high!r})" for value, low, high in limits])]


@answer_lines.register
def _(head: TanhBox, outputs: Sequence[str], names: Names) -> list[str]:
    return [_returned(_squashed(head, len(outputs), outputs))]


@answer_lines.register
def _(head: PidBox, outputs: Sequence[str], names: Names) -> list[str]:
    controls = zip(names.answer_ids, joined(outputs, len(names.answers)), strict=True)
    lines = [line for answer, control in controls for line in _statement(f"{answer} = ", control, "", "")]
    return [*lines, _returned(_squashed(head, len(outputs), names.answer_ids))]


@answer_lines.register
def _(head: Sign, outputs: Sequence[str], names: Names) -> list[str]:
    return [f"return 1 if {outputs[0]} > 0 else 0"]


@answer_lines.register
def _(head: Argmax, outputs: Sequence[str], names: Names) -> list[str]:
    lines = [f"outputs = [{', '.join(outputs)}]"] if outputs == names.output_ids else []
    return [*lines, "return outputs.index(max(outputs))"]


def _returned(values: Sequence[str]) -> str:
    return f"return [{', '.join(values)}]"


def _squashed(head: TanhBox | PidBox, n_outputs: int, values: Sequence[str]) -> list[str]:
    halves, middles = (part.tolist() for part in head.halves_and_middles(n_outputs))
    return [
        f"tanh({value})" if (half, middle) == (1.0, 0.0) else f"{middle!r} + {half!r} * tanh({value})"
        for value, half, middle in zip(values, halves, middles, strict=True)
    ]
