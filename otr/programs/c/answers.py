"""What makes the answer of the affine outputs in C: for every head its tables, its lines and its array of outputs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch

import numpy as np

from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, PidBox, Sign, TanhBox
from otr.programs.c.tables import CType, Table, literal, real_table


@dataclass(frozen=True)
class Answer:
    """A piece of C that makes the answer of the outputs."""

    lines: list[str]
    tables: list[Table]  # that the lines read
    array: str = "y"  # of the outputs; y is the answer's own where the answer is numbers
    declared: tuple[str, ...] = ()  # the declaration of that array, if it is another
    calls: str = ""  # a function of the mathematical library


@singledispatch
def answer_of(head: Head, n_outputs: int, name: str, dtype: CType) -> Answer:
    """Return the answer under a head, in a program with this prefix and type."""
    raise no_entry(head, "to_c")


@answer_of.register
def _(head: Identity, n_outputs: int, name: str, dtype: CType) -> Answer:
    return Answer([], [])


@answer_of.register
def _(head: Exp, n_outputs: int, name: str, dtype: CType) -> Answer:
    exp = "exp" if dtype == "double" else "expf"
    return Answer([f"    for (k = 0; k < {n_outputs}; k++)", f"        y[k] = {exp}(y[k]);"], [], calls="exp")


@answer_of.register
def _(head: ClipBox, n_outputs: int, name: str, dtype: CType) -> Answer:
    low, high = head.limits(n_outputs)
    tables, (lows, highs) = _per_output(name, {"low": low, "high": high}, dtype)
    clipped = f"        y[k] = y[k] < {lows} ? {lows} : y[k] > {highs} ? {highs} : y[k];"
    return Answer([f"    for (k = 0; k < {n_outputs}; k++)", clipped], tables)


@answer_of.register
def _(head: TanhBox, n_outputs: int, name: str, dtype: CType) -> Answer:
    tables, squashed = _squashed(head, n_outputs, name, dtype, "y[k]")
    return Answer([f"    for (k = 0; k < {n_outputs}; k++)", f"        y[k] = {squashed};"], tables, calls="tanh")


@answer_of.register
def _(head: PidBox, n_outputs: int, name: str, dtype: CType) -> Answer:
    n_actions, n_terms = head.n_answers(n_outputs), head.n_terms(n_outputs)
    tables, squashed = _squashed(head, n_outputs, name, dtype, "sum")
    lines = [
        f"    for (k = 0; k < {n_actions}; k++) {{",
        f"        const {dtype} *gains = u + {n_terms} * (k + 1);",
        f"        {dtype} sum = 0;",
        "        int j;",
        f"        for (j = 0; j < {n_terms}; j++)",
        "            sum += gains[j] * u[j];",
        f"        y[k] = {squashed};",
        "    }",
    ]
    declared = f"    {dtype} u[{n_outputs}];  /* P, I and D, then each action's gains */"
    return Answer(lines, tables, "u", (declared,), calls="tanh")


@answer_of.register
def _(head: Sign, n_outputs: int, name: str, dtype: CType) -> Answer:
    return Answer(["    return y[0] > 0;"], [], declared=(f"    {dtype} y[{n_outputs}];",))


@answer_of.register
def _(head: Argmax, n_outputs: int, name: str, dtype: CType) -> Answer:
    lines = [
        "    {",
        "        int best = 0;",
        f"        for (k = 1; k < {n_outputs}; k++)",
        "            if (y[k] > y[best])",
        "                best = k;",
        "        return best;",
        "    }",
    ]
    return Answer(lines, [], declared=(f"    {dtype} y[{n_outputs}];",))


def _squashed(head: TanhBox | PidBox, n_outputs: int, name: str, dtype: CType, value: str) -> tuple[list[Table], str]:
    """Return tables, and an expression's tanh in the box of answer k."""
    half, middle = head.halves_and_middles(n_outputs)
    tanh = f"{'tanh' if dtype == 'double' else 'tanhf'}({value})"
    if (half == 1).all() and (middle == 0).all():
        return [], tanh
    tables, (halves, middles) = _per_output(name, {"half": half, "middle": middle}, dtype)
    return tables, f"{middles} + {halves} * {tanh}"


def _per_output(name: str, limits: dict[str, np.ndarray], dtype: CType) -> tuple[list[Table], list[str]]:
    """Return each limit of output k as an expression: a literal where all outputs share it, else from a table."""
    tables, expressions = [], []
    for what, values in limits.items():
        if (values == values[0]).all():
            expressions.append(literal(float(values[0]), dtype))
        else:
            tables.append(real_table(f"{name}_{what}", np.ascontiguousarray(values), dtype))
            expressions.append(f"{name}_{what}[k]")
    return tables, expressions
