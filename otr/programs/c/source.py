"""A policy as one C99 source file: constant tables, a loop, no heap, no recursion, no state."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from otr.core.fixed_point.tree import FixedPointTree
from otr.core.mapping import map_network
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.smooth_network import Layered
from otr.core.tree import ObliqueTree
from otr.programs.c.answers import Answer, answer_of
from otr.programs.c.fixed_point import fixed_point_code
from otr.programs.c.float_error import FloatErrorBound
from otr.programs.c.network import functions_of, network_code
from otr.programs.c.reserved_words import is_function_name
from otr.programs.c.tables import CType, Table, integer_table, integer_type, row_table
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import check_policy, give_labels, in_comment, shown_names
from otr.programs.walk import WIDTH, child, distinct_rows, require_float_rows, summary_of

_OF_STDINT = ("static const int", "static const uint")


def to_c(
    policy: ObliqueTree | PatternTree | Layered | FixedPointTree,
    *,
    name: str = "policy",
    dtype: CType = "double",
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    error: FloatErrorBound | None = None,
    test_states: ArrayLike | None = None,
) -> str:
    """Return a C99 source file that answers as ``policy.predict`` does.

    It defines ``void name(const double x[d], double y[n])``, of as many numbers as the answer has, or, where the
    answers are labels, ``int name_label(const double x[d])``. It compiles without a warning under -Wall -Wextra
    -Werror -pedantic, uses neither heap nor recursion, and all its data is constant, so that it lands in flash. Test
    rows and leaf rows that repeat are stored once, dense or sparse, and indices have the smallest type that fits.

    A network is written in its own, compact form: every neuron is evaluated once and adds to what it feeds, which
    takes the fewest bytes, where a tree has a map for every leaf. A `PatternTree` of all paths is written as its
    network; one that is restricted to some paths, as the tree of these. A network of smooth units, such as the tanh
    of Stable-Baselines3's PPO, which no tree equals, is written with the functions of the mathematical library.

    A `FixedPointTree` becomes ``void name(const int16_t x[d], int32_t y[n])``, or ``int name_label(...)``, of its own
    words: integers alone, without division, the tables in flash on an AVR, too. It answers as ``predict_integers``.

    Args:
        policy: a tree, or a network; what `read_policy` returns, unless that is a black box.
        name: prefix of everything that the file defines.
        dtype: "double", or "float" for controllers that have no unit for more; numbers are rounded to it. Of no meaning
            for a `FixedPointTree`.
        feature_names, output_names: as in `to_text`, for the comment at the top.
        error: what `float_error` returned for the tree and the type, which the comment says.
        test_states: of a `FixedPointTree` integers (n, d), for which the file has a ``main()`` that returns 0 if all
            answers are Python's, compiled where ``NAME_TEST`` is defined, and one that answers integers from the
            standard input, where ``NAME_MAIN`` is.

    Raises:
        TypeError: `policy` is something else.
        ValueError: the wrong number of names, names that are not distinct, a `name` that C does not take, another
            `dtype`, or a number that is too large for a float, or too small in a test.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> "void policy(" in otr.to_c(tree)
        True
    """
    if not isinstance(policy, ObliqueTree | PatternTree | Layered | FixedPointTree):
        raise TypeError(f"policy is a {type(policy).__name__}, expected an ObliqueTree, a PatternTree or a network")
    if not is_function_name(name):
        raise ValueError(f"name is {name!r}, which cannot be the name of a C function")
    if dtype not in ("double", "float"):
        raise ValueError(f"dtype is {dtype!r}, expected 'double' or 'float'")
    if isinstance(policy, FixedPointTree):
        check_policy(policy.to_tree())
        return fixed_point_code(policy, name, feature_names, output_names, test_states)
    if test_states is not None:
        raise ValueError("test_states are integers of a FixedPointTree; of other policies leave them out")
    if isinstance(policy, PatternTree):
        policy = policy.to_tree() if policy.is_restricted else policy.network
    if isinstance(policy, Layered) and policy.n_hidden == 0:
        policy = map_network(ReluNetwork(policy.weights, policy.biases, head=policy.head))
    if isinstance(policy, ObliqueTree):
        policy = merge_equal_leaves(policy)
    check_policy(policy)
    features, answers = shown_names(policy, feature_names, output_names)
    bound = _bound(error, dtype)
    if isinstance(policy, ObliqueTree) and policy.labels is not None:
        answer = Answer([], [])
    else:
        answer = answer_of(policy.head, policy.n_outputs, name, dtype)
    if dtype == "float":
        for rows in (policy.test_forms[:, :-1],) if isinstance(policy, ObliqueTree) else policy.weights:
            require_float_rows(rows)
    if isinstance(policy, ObliqueTree):
        tables, body = _tree(policy, answer, name, dtype)
        calls = [answer.calls]
    else:
        tables, body = network_code(policy, answer, name, dtype)
        calls = [*functions_of(policy), answer.calls]
    tables += answer.tables
    n_bytes = sum(table.n_bytes for table in tables)
    declared = _signature(policy, name, dtype)
    lines = _comment(policy, declared, n_bytes, features, answers, ", ".join(sorted({*calls} - {""})))
    lines[-1:] = [*bound, lines[-1]]
    written = [line for table in tables for line in table.lines]
    lines += ["#include <math.h>"] if any(calls) else []
    lines += ["#include <stdint.h>"] if any(line.startswith(_OF_STDINT) for line in written) else []
    lines += ["", *written, "", f"{declared};  /* so that no compiler misses a prototype */", "", declared]
    return re.sub("\n{3,}", "\n\n", "\n".join([*lines, "{", *body, *answer.lines, "}"])) + "\n"


def _bound(error: FloatErrorBound | None, dtype: CType) -> list[str]:
    """Return the lines of the comment that say what rounding changes over a box."""
    if error is None:
        return []
    if error.dtype != dtype:
        raise ValueError(f"error is of dtype {error.dtype!r}, the program of {dtype!r}")
    sides = ", ".join(f"[{low:g}, {high:g}]" for low, high in zip(error.box.low, error.box.high, strict=True))
    return [" *", *textwrap.wrap(f"For x in {sides}: {error}.", WIDTH, initial_indent=" * ", subsequent_indent=" * ")]


def _signature(policy: ObliqueTree | Layered, name: str, dtype: CType) -> str:
    if give_labels(policy):
        return f"{_label_type(policy)} {name}_label(const {dtype} x[{policy.n_inputs}])"
    return f"void {name}(const {dtype} x[{policy.n_inputs}], {dtype} y[{policy.head.n_answers(policy.n_outputs)}])"


def _label_type(policy: ObliqueTree | Layered) -> str:
    labels = policy.labels if isinstance(policy, ObliqueTree) and policy.labels is not None else np.zeros(1, np.int64)
    n_bytes = integer_type(np.append(labels, -1))[1]
    return {1: "int", 2: "int", 4: "long", 8: "long long"}[n_bytes]


def _comment(
    policy: ObliqueTree | Layered,
    declared: str,
    n_bytes: int,
    features: Sequence[str],
    answers: Sequence[str],
    calls: str,
) -> list[str]:
    """Return the comment at the top: how to call, inputs, outputs, sizes."""
    if isinstance(policy, ObliqueTree):
        what = summary_of(policy)
    else:
        what = f"a network of {policy.n_hidden} hidden neurons"
        if isinstance(policy, ReluNetwork):
            what += f", which is a tree of {policy.n_hidden} tests on a path"
        else:
            what += f" with the activation {policy.activation}"
    lines = [f"/* {what[0].upper()}{what[1:]}.", " *", f" *     {declared};", " *"]
    lines += [f" * x[{i}]  {in_comment(feature)}" for i, feature in enumerate(features)]
    if give_labels(policy):
        lines += [f" * {i:4d}  {in_comment(answer)}" for i, answer in enumerate(answers) if answer != str(i)]
    else:
        lines += [f" * y[{i}]  {in_comment(answer)}{_range(policy, i)}" for i, answer in enumerate(answers)]
        lines += [" *", " * x and y must not overlap."]
    lines += [
        " *",
        f" * {n_bytes:,} bytes of constant tables. No heap, no recursion, no variable that outlives a call.",
        *([f" * Link with the mathematical library (-lm) for {calls}."] if calls else []),
        " */",
    ]
    return lines


def _range(policy: ObliqueTree | Layered, output: int) -> str:
    limits = policy.head.limits(policy.n_outputs)
    return "" if limits is None else f", in [{limits[0][output]:g}, {limits[1][output]:g}]"


def _tree(tree: ObliqueTree, answer: Answer, name: str, dtype: CType) -> tuple[list[Table], list[str]]:
    """Return tables, and the lines that find the leaf and write its outputs, or return its label."""
    tables: list[Table] = []
    index = "int" if tree.n_leaves * tree.n_outputs < 2**15 else "long"
    body = []
    if tree.n_nodes:
        tests, test_of = distinct_rows(tree.test_forms)
        tables = [row_table(f"{name}_tests", tests, dtype), integer_table(f"{name}_children", child(tree))]
        test = "node"
        if not np.array_equal(test_of, np.arange(tree.n_nodes)):
            tables.append(integer_table(f"{name}_test", test_of))
            test = f"{name}_test[node]"
        body = [
            f"    {index} node = 0;",
            "    while (node >= 0)  /* a negative child is the leaf ~child */",
            f"        node = ({index}){name}_children[node][{name}_tests_at({test}, x) > 0];",
        ]
    leaf = "~node" if tree.n_nodes else "0"
    if tree.labels is not None:
        tables.append(integer_table(f"{name}_labels", tree.labels))
        unused = [] if tree.n_nodes else ["    (void)x;"]
        return tables, [*body, *unused, f"    return {name}_labels[{leaf}];"]
    rows, row_of = distinct_rows(tree.leaf_forms.reshape(-1, tree.n_inputs + 1))
    tables.append(row_table(f"{name}_rows", rows, dtype))
    row = f"{tree.n_outputs}L * ({leaf}) + k"
    if not np.array_equal(row_of, np.arange(len(row_of))):
        tables.append(integer_table(f"{name}_leaves", row_of.reshape(tree.n_leaves, tree.n_outputs)))
        row = f"{name}_leaves[{leaf}][k]"
    return tables, [
        *answer.declared,
        *body[:1],
        "    int k;",
        *body[1:],
        f"    for (k = 0; k < {tree.n_outputs}; k++)",
        f"        {answer.array}[k] = {name}_rows_at({row}, x);",
    ]
