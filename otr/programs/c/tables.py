"""Constant tables in C: literals that lose nothing, integers in the smallest type, rows in the least bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray, IntArray
from otr.programs.walk import wrapped

CType = Literal["double", "float"]
N_BYTES = {"double": 8, "float": 4}
_INTEGERS = tuple((f"{sign}int{bits}_t", bits // 8, np.iinfo(f"{sign}int{bits}")) for bits in (8, 16, 32, 64)
                  for sign in ("u", ""))  # fmt: skip


@dataclass(frozen=True)
class Table:
    """A piece of C: tables, perhaps with the function that reads them, and the bytes that the tables take."""

    lines: list[str]
    n_bytes: int


def literal(value: float, dtype: CType) -> str:
    """Return the shortest literal of exactly this number; raise ValueError if a float cannot hold it."""
    if dtype == "double":
        return repr(float(value))
    with np.errstate(over="ignore", under="ignore"):
        rounded = np.float32(value)
    if not np.isfinite(rounded):
        raise ValueError(f"the policy holds the number {value:.6g}, too large for a float; use dtype='double'")
    return f"{rounded!s}f"


def integer_type(values: IntArray) -> tuple[str, int]:
    """Return the smallest type of stdint.h that holds the values, and its bytes."""
    low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
    return next((name, n_bytes) for name, n_bytes, info in _INTEGERS if info.min <= low and high <= info.max)


def integer_table(name: str, values: IntArray) -> Table:
    """Return the declaration of a table of integers of one or two axes."""
    kind, n_bytes = integer_type(values)
    return Table(_declaration(kind, name, values, _integer), values.size * n_bytes)


def real_table(name: str, values: FloatArray, dtype: CType) -> Table:
    """Return the declaration of a table of real numbers of one or two axes."""
    lines = _declaration(dtype, name, values, lambda value: literal(value, dtype))
    return Table(lines, values.size * N_BYTES[dtype])


def row_layout(rows: FloatArray, dtype: CType) -> Literal["constant", "dense", "single", "sparse"]:
    """Return how `row_table` stores distinct rows (n, d + 1): in the way that takes the fewest bytes."""
    per_row = np.count_nonzero(rows[:, :-1], axis=1)
    columns = np.nonzero(rows[:, :-1])[1]
    if not len(columns):
        return "constant"
    dense = rows.size * N_BYTES[dtype]
    values = len(columns) * (N_BYTES[dtype] + integer_type(columns)[1]) + len(rows) * N_BYTES[dtype]
    if dense <= values:
        return "dense"
    if per_row.max() == 1:
        return "single"
    starts = np.concatenate(([0], np.cumsum(per_row)))
    return "dense" if dense <= values + len(starts) * integer_type(starts)[1] else "sparse"


def row_table(name: str, rows: FloatArray, dtype: CType) -> Table:
    """Return affine rows (n, d + 1), the offset last, and the function ``name_at(row, x)`` that evaluates one of them.

    The rows are dense, sparse (coefficients with their columns), with a single coefficient each, or constant,
    whichever takes the fewest bytes.
    """
    coefficients, offsets = rows[:, :-1], rows[:, -1]
    head = [f"static {dtype} {name}_at(long i, const {dtype} *x)", "{"]
    layout = row_layout(rows, dtype)
    if layout == "constant":
        table = real_table(name, offsets, dtype)
        return Table([*table.lines, "", *head, "    (void)x;", f"    return {name}[i];", "}", ""], table.n_bytes)
    if layout != "sparse":
        return (_dense if layout == "dense" else _single)(name, rows, dtype, head)
    used_rows, columns = np.nonzero(coefficients)
    starts = np.concatenate(([0], np.cumsum(np.count_nonzero(coefficients, axis=1))))
    parts = [
        integer_table(f"{name}_starts", starts),
        integer_table(f"{name}_columns", columns),
        real_table(f"{name}_weights", coefficients[used_rows, columns], dtype),
        real_table(f"{name}_offsets", offsets, dtype),
    ]
    body = [
        f"    {dtype} sum = {name}_offsets[i];",
        "    long k;",
        f"    for (k = {name}_starts[i]; k < (long){name}_starts[i + 1]; k++)",
        f"        sum += {name}_weights[k] * x[{name}_columns[k]];",
        "    return sum;",
        "}",
        "",
    ]
    return _with_function(parts, [*head, *body])


def _dense(name: str, rows: FloatArray, dtype: CType, head: list[str]) -> Table:
    """Return rows in full, summed in two parts, so that an addition need not wait for the one before it."""
    d = rows.shape[1] - 1
    body = [
        f"    const {dtype} *row = {name}[i];",
        f"    {dtype} sum = row[{d}]{f' + row[{d - 1}] * x[{d - 1}]' if d % 2 else ''}, odd = 0;",
        "    int k;",
        f"    for (k = 0; k < {d - d % 2}; k += 2) {{",
        "        sum += row[k] * x[k];",
        "        odd += row[k + 1] * x[k + 1];",
        "    }",
        "    return sum + odd;",
        "}",
        "",
    ]
    return _with_function([real_table(name, rows, dtype)], [*head, *body])


def _single(name: str, rows: FloatArray, dtype: CType, head: list[str]) -> Table:
    """Return rows of at most one coefficient each; one that has none multiplies x[0] by zero."""
    columns = np.argmax(rows[:, :-1] != 0, axis=1)
    weights = rows[np.arange(len(rows)), columns]
    parts = [
        integer_table(f"{name}_column", columns),
        real_table(name, np.column_stack((weights, rows[:, -1])), dtype),
    ]
    body = [f"    return {name}[i][1] + {name}[i][0] * x[{name}_column[i]];", "}", ""]
    return _with_function(parts, [*head, *body])


def _with_function(parts: list[Table], function: list[str]) -> Table:
    lines = [line for part in parts for line in part.lines]
    return Table([*lines, "", *function], sum(part.n_bytes for part in parts))


def integer_declaration(kind: str, name: str, values: IntArray, place: str) -> list[str]:
    """Return the declaration of a table of integers of a given type, with an attribute that says where it lies."""
    return _declaration(kind, name, values, _integer, place)


def _declaration(kind: str, name: str, values: NDArray[Any], write: Callable[[Any], str], place: str = "") -> list[str]:
    shape = "".join(f"[{n}]" for n in values.shape)
    if values.ndim == 1:
        rows = [", ".join(write(value) for value in values.tolist())]
    else:
        rows = [f"{{{', '.join(write(value) for value in row)}}}," for row in values.tolist()]
    lines = [line for row in rows for line in wrapped(row, "    ")]
    return [f"static const {kind} {name}{shape}{place} = {{", *lines, "};"]


def _integer(value: int) -> str:
    return "INT64_MIN" if value == -(2**63) else str(value)
