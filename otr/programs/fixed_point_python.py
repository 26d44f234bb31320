"""A tree in fixed point as a Python module of integers alone, which MicroPython runs, too."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch

import numpy as np

from otr.core.fixed_point.tree import FixedPointTree
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Identity, Sign, TanhBox
from otr.programs.names import check_tree, shown_names
from otr.programs.walk import distinct_integers, summary_of, wrapped

_PLUS = ("def _plus(s, row, q):", "    for i in range(len(q)):", "        s += row[i] * q[i]", "    return s")


def fixed_point_python(
    fixed: FixedPointTree, name: str, feature_names: Sequence[str] | None, output_names: Sequence[str] | None
) -> str:
    """Return the module: tables as tuples, and the function ``name(x)`` of d integers."""
    tree = fixed.to_tree()
    check_tree(tree)
    features, answers = shown_names(tree, feature_names, output_names)
    # Python looks for a declaration of the file's encoding in comments on the first two lines: no name goes there.
    what = summary_of(tree)
    lines = [
        f"# {what[0].upper()}{what[1:]}, in integers of {fixed.bits} bits.",
        "# It needs nothing but integers.",
        "#",
    ]
    for i, (feature, scale) in enumerate(zip(features, fixed.input_scales, strict=True)):
        lines.append(f"# x[{i}]: {feature} = {float(scale):.9g} x[{i}]")
    labelled = fixed.labels is not None or fixed.head.gives_labels
    for k, answer in enumerate(answers):
        offset = "" if labelled or not fixed.output_offsets[k] else f" + {float(fixed.output_offsets[k]):.9g}"
        meaning = f"answer {k}: {answer}" if labelled else f"y[{k}]: {answer} = "
        lines.append(f"# {meaning}{'' if labelled else f'{float(fixed.output_scales[k]):.9g} y[{k}]{offset}'}")
    halves = (1 << fixed.shifts) >> 1
    parts = np.concatenate((fixed.M, (fixed.c + halves)[..., None], fixed.shifts[..., None]), axis=2)
    tests, test_of = distinct_integers(np.column_stack((fixed.P, fixed.v)))
    rows, row_of = distinct_integers(parts.reshape(-1, fixed.n_inputs + 2))
    nodes = np.column_stack((test_of, fixed.children_left, fixed.children_right))
    tables = {"_TESTS": tests.tolist(), "_NODES": nodes.tolist()} if fixed.n_nodes else {}
    limits = np.column_stack((fixed.input_low, fixed.input_high)).tolist()
    if fixed.labels is not None:
        tables["_LABELS"] = fixed.labels.tolist()
        answered = ["    return _LABELS[leaf]"]
    else:
        tables |= {"_ROWS": rows.tolist(), "_LEAVES": row_of.reshape(fixed.n_leaves, -1).tolist()}
        answered = [
            "    y = []",
            "    for i in _LEAVES[leaf]:",
            "        row = _ROWS[i]",
            "        y.append(_plus(row[-2], row, q) >> row[-1])  # rounds down",
            *_answered(fixed.head, fixed),
        ]
        if fixed.table is not None:
            tables["_TANH"] = fixed.table.values.tolist()
    for table, values in {"_LIMITS": limits, **tables}.items():
        lines += ["", *wrapped(f"{table} = {_tuple(values)}", "")]
    lines += ["", "", *_PLUS, "", "", f"def {name}(x):"]
    lines.append("    q = [min(max(x[i], _LIMITS[i][0]), _LIMITS[i][1]) for i in range(len(x))]")
    lines.append("    node = 0" if fixed.n_nodes else "    leaf = 0")
    if fixed.n_nodes:
        lines += [
            "    while node >= 0:  # a negative child is the leaf ~child",
            "        test, left, right = _NODES[node]",
            "        row = _TESTS[test]",
            "        node = right if _plus(row[-1], row, q) > 0 else left",
            "    leaf = ~node",
        ]
    return "\n".join([*lines, *answered]) + "\n"


def _tuple(values: Sequence[object]) -> str:
    """Return nested tuples."""
    items = [_tuple(value) if isinstance(value, list) else str(value) for value in values]
    return f"({', '.join(items)}{',' if len(items) == 1 else ''})"


@singledispatch
def _answered(head: Head, fixed: FixedPointTree) -> list[str]:
    """Return the lines that answer, given y."""
    raise no_entry(head, "to_python of a FixedPointTree")


@_answered.register
def _(head: Identity, fixed: FixedPointTree) -> list[str]:
    return ["    return y"]


@_answered.register
def _(head: ClipBox, fixed: FixedPointTree) -> list[str]:
    assert fixed.output_limits is not None
    low, high = (_tuple(limits.tolist()) for limits in fixed.output_limits)
    return [f"    low, high = {low}, {high}", "    return [min(max(y[k], low[k]), high[k]) for k in range(len(y))]"]


@_answered.register
def _(head: TanhBox, fixed: FixedPointTree) -> list[str]:
    table = fixed.table
    assert table is not None
    step, n_steps = table.step_bits, table.values.shape[1] - 1
    return [
        "    for k in range(len(y)):  # tanh, linear between the numbers of a table",
        f"        table, a = _TANH[{0 if len(table.values) == 1 else 'k'}], min(abs(y[k]), {table.last})",
        f"        at = min(a >> {step}, {n_steps - 1})",
        f"        rise = (table[at + 1] - table[at]) * (a - (at << {step}))",
        f"        a = table[at] + ((rise + {(1 << step) >> 1}) >> {step})",
        "        y[k] = -a if y[k] < 0 else a",
        "    return y",
    ]


@_answered.register
def _(head: Sign, fixed: FixedPointTree) -> list[str]:
    return ["    return int(y[0] > 0)"]


@_answered.register
def _(head: Argmax, fixed: FixedPointTree) -> list[str]:
    return ["    return y.index(max(y))"]
