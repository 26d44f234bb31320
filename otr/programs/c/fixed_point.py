"""A tree in fixed point as one C99 source file: integers alone, no division, no heap, no recursion, no state."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import IntArray
from otr.core.fixed_point.tree import FixedPointTree
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Identity, Sign, TanhBox
from otr.programs.c.tables import Table, integer_declaration
from otr.programs.names import give_labels, in_comment, shown_names
from otr.programs.walk import distinct_integers, summary_of

# How a number of so many bits is read from the flash of an AVR, which has an address space of its own.
_READS = {
    8: "((int8_t)pgm_read_byte(at))",
    16: "((int16_t)pgm_read_word(at))",
    32: "((int32_t)pgm_read_dword(at))",
    64: "((int64_t)(((uint64_t)pgm_read_dword((const uint32_t *)(at) + 1) << 32)"
    " | pgm_read_dword((const uint32_t *)(at))))",
}


@dataclass(frozen=True)
class FixedCode:
    """A fixed-point tree as parts of a C file."""

    fixed: FixedPointTree
    name: str
    features: Sequence[str]
    answers: Sequence[str]

    @property
    def gives_labels(self) -> bool:
        """Whether the answer is a label."""
        return give_labels(self.fixed.to_tree())

    @property
    def sum_type(self) -> str:
        """The type of sums, and of answers that are no labels."""
        return f"int{self.fixed.accumulator_bits}_t"

    @property
    def input_type(self) -> str:
        """The type of inputs."""
        return f"int{self.fixed.input_bits}_t"

    @property
    def label_bits(self) -> int:
        """Bits of a label."""
        return _bits_of(np.zeros(1, np.int64) if self.fixed.labels is None else self.fixed.labels)

    @property
    def answer(self) -> str:
        """The type and name of the function, without its arguments."""
        if self.gives_labels:
            return f"{'int' if self.label_bits <= 16 else f'int{self.label_bits}_t'} {self.name}_label"
        return f"void {self.name}"

    @property
    def signature(self) -> str:
        """The function's declaration, without semicolon."""
        outputs = "" if self.gives_labels else f", {self.sum_type} y[{self.fixed.n_outputs}]"
        return f"{self.answer}(const {self.input_type} x[{self.fixed.n_inputs}]{outputs})"

    def read(self, bits: int, place: str) -> str:
        """Return the expression that reads a constant at a place."""
        return f"{self.name.upper()}_READ{bits}({place})"

    def table(self, what: str, values: IntArray) -> tuple[Table, int]:
        """Return a table in the smallest type that has a sign, and its bits."""
        bits = _bits_of(values)
        name = f"{self.name}_{what}"
        lines = integer_declaration(f"int{bits}_t", name, values, f" {self.name.upper()}_FLASH")
        return Table(lines, values.size * bits // 8), bits


def fixed_point_code(
    fixed: FixedPointTree,
    name: str,
    feature_names: Sequence[str] | None,
    output_names: Sequence[str] | None,
    test_states: ArrayLike | None,
) -> str:
    """Return the C file of `to_c` of a fixed-point tree."""
    code = FixedCode(fixed, name, *shown_names(fixed.to_tree(), feature_names, output_names))
    leaf_tables, leaf = _leaf(code)
    tables, body = _tests(code)
    tables += leaf_tables
    reads_rows = bool(fixed.n_nodes) or fixed.labels is None
    row = _row_function(code) if reads_rows else []
    limits, clamped = _clamped_inputs(code)
    tables += limits
    text = [*(line for table in tables for line in table.lines), "", *row, *_shift_function(code)]
    text += [f"{code.signature};  /* so that no compiler misses a prototype */", "", code.signature, "{"]
    text += [*clamped, *body, *leaf, "}"]
    n_bytes = sum(table.n_bytes for table in tables)
    lines = [*_comment(code, n_bytes), "#include <stdint.h>", *_macros(code, text), "", *text]
    if test_states is not None:
        lines += [*_self_test(code, np.asarray(test_states)), *_main(code)]
    return re.sub("\n{3,}", "\n\n", "\n".join(lines)) + "\n"


def _bits_of(values: IntArray) -> int:
    """Return the bits of the smallest type with a sign that holds the values."""
    low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
    return next(bits for bits in (8, 16, 32, 64) if -(2 ** (bits - 1)) <= low and high < 2 ** (bits - 1))


def _comment(code: FixedCode, n_bytes: int) -> list[str]:
    fixed, what = code.fixed, summary_of(code.fixed.to_tree())
    lines = [f"/* {what[0].upper()}{what[1:]}, in integers of {fixed.bits} bits.", " *", f" *     {code.signature};"]
    lines += [" *"]
    for i, (feature, scale) in enumerate(zip(code.features, fixed.input_scales, strict=True)):
        low, high = int(fixed.input_low[i]), int(fixed.input_high[i])
        lines.append(f" * x[{i}]  {in_comment(feature)} = {float(scale):.9g} x[{i}], clamped to [{low}, {high}]")
    if code.gives_labels:
        lines += [f" * {i:4d}  {in_comment(answer)}" for i, answer in enumerate(code.answers) if answer != str(i)]
    else:
        for k, answer in enumerate(code.answers):
            offset = float(fixed.output_offsets[k])
            above = f" + {offset:.9g}" if offset else ""
            lines.append(f" * y[{k}]  {in_comment(answer)} = {float(fixed.output_scales[k]):.9g} y[{k}]{above}")
    return [
        *lines,
        " *",
        f" * No sum overflows {fixed.accumulator_bits} bits, whatever x is. {n_bytes:,} bytes of constant tables.",
        " * No floating point, no division, no heap, no recursion, no variable that outlives a call.",
        " */",
    ]


def _macros(code: FixedCode, text: list[str]) -> list[str]:
    """Return the macros that put tables into flash and read them there, of the widths that the text reads."""
    prefix, joined = code.name.upper(), "\n".join(text)
    used = [bits for bits in _READS if f"{prefix}_READ{bits}(" in joined]
    on_avr = ["#include <avr/pgmspace.h>", f"#define {prefix}_FLASH PROGMEM"]
    on_avr += [f"#define {prefix}_READ{bits}(at) {_READS[bits]}" for bits in used]
    elsewhere = [f"#define {prefix}_FLASH", *(f"#define {prefix}_READ{bits}(at) (*(at))" for bits in used)]
    return ["#ifdef __AVR__", *on_avr, "#else", *elsewhere, "#endif"]


def _clamped_inputs(code: FixedCode) -> tuple[list[Table], list[str]]:
    """Return tables, and the lines that clamp the inputs to an array q."""
    fixed, d = code.fixed, code.fixed.n_inputs
    tables, limits = list[Table](), list[str]()
    for what, values in (("lowest", fixed.input_low), ("highest", fixed.input_high)):
        if (values == values[0]).all():
            limits.append(str(int(values[0])))
        else:
            table = integer_declaration(code.input_type, f"{code.name}_{what}", values, f" {code.name.upper()}_FLASH")
            tables.append(Table(table, values.size * fixed.input_bits // 8))
            limits.append(code.read(fixed.input_bits, f"{code.name}_{what} + i"))
    lines = [f"    {code.input_type} q[{d}];", "    int i;", f"    for (i = 0; i < {d}; i++) {{"]
    lines += [f"        const {code.input_type} low = {limits[0]}, high = {limits[1]};", "        q[i] = x[i];"]
    lines += [
        "        if (q[i] < low)",
        "            q[i] = low;",
        "        if (q[i] > high)",
        "            q[i] = high;",
    ]
    lines.append("    }")
    return tables, lines


def _row_function(code: FixedCode) -> list[str]:
    fixed = code.fixed
    bits = _bits_of(np.array([2 ** (fixed.bits - 1) - 1]))
    return [
        f"static {code.sum_type} {code.name}_plus({code.sum_type} sum, const int{bits}_t *row, "
        f"const {code.input_type} *q)",
        "{",
        "    int k;",
        f"    for (k = 0; k < {fixed.n_inputs}; k++)",
        f"        sum += ({code.sum_type}){code.read(bits, 'row + k')} * ({code.sum_type})q[k];",
        "    return sum;",
        "}",
        "",
    ]


def _shift_function(code: FixedCode) -> list[str]:
    """Return the shift to the right that rounds down, which C leaves open for negative numbers."""
    if code.fixed.labels is not None or not code.fixed.shifts.any():
        return []
    return [
        f"static {code.sum_type} {code.name}_shifted({code.sum_type} sum, int by)",
        "{",
        "    return sum < 0 ? ~(~sum >> by) : sum >> by;",
        "}",
        "",
    ]


def _coefficients(code: FixedCode, what: str, rows: IntArray) -> Table:
    """Return a table of coefficients, all in the word of the tree."""
    bits = _bits_of(np.array([2 ** (code.fixed.bits - 1) - 1]))
    lines = integer_declaration(f"int{bits}_t", f"{code.name}_{what}", rows, f" {code.name.upper()}_FLASH")
    return Table(lines, rows.size * bits // 8)


def _tests(code: FixedCode) -> tuple[list[Table], list[str]]:
    """Return tables, and the lines that find the leaf."""
    fixed, name = code.fixed, code.name
    index = "int" if fixed.n_leaves * fixed.n_outputs < 2**15 else "int32_t"
    if not fixed.n_nodes:
        return [], [f"    const {index} leaf = 0;"]
    rows, row_of = distinct_integers(np.column_stack((fixed.P, fixed.v)))
    (offsets, offset_bits) = code.table("test_offsets", rows[:, -1])
    children, child_bits = code.table("children", np.stack((fixed.children_left, fixed.children_right), axis=1))
    tables, test = [_coefficients(code, "tests", rows[:, :-1]), offsets, children], "node"
    if not np.array_equal(row_of, np.arange(fixed.n_nodes)):
        tests, test_bits = code.table("test", row_of)
        tables.append(tests)
        test = code.read(test_bits, f"{name}_test + node")
    return tables, [
        f"    {index} node = 0, leaf;",
        "    while (node >= 0) {  /* a negative child is the leaf ~child */",
        f"        const {index} test = {test};",
        f"        const {code.sum_type} sum = {name}_plus({code.read(offset_bits, f'{name}_test_offsets + test')}, "
        f"{name}_tests[test], q);",
        f"        node = {code.read(child_bits, f'&{name}_children[node][sum > 0]')};",
        "    }",
        "    leaf = ~node;",
    ]


def _leaf(code: FixedCode) -> tuple[list[Table], list[str]]:
    """Return tables, and the lines that answer at a leaf."""
    fixed, name, o = code.fixed, code.name, code.fixed.n_outputs
    if fixed.labels is not None:
        labels, bits = code.table("labels", fixed.labels)
        unused = [] if fixed.n_nodes else ["    (void)q;"]
        return [labels], [*unused, f"    return {code.read(bits, f'{name}_labels + leaf')};"]
    halves = (1 << fixed.shifts) >> 1
    parts = np.concatenate((fixed.M, (fixed.c + halves)[..., None], fixed.shifts[..., None]), axis=2)
    rows, row_of = distinct_integers(parts.reshape(-1, fixed.n_inputs + 2))
    offsets, offset_bits = code.table("row_offsets", rows[:, -2])
    tables, row = [_coefficients(code, "rows", rows[:, :-2]), offsets], f"{o} * leaf + k"
    if not np.array_equal(row_of, np.arange(len(row_of))):
        of_leaves, row_bits = code.table("leaves", row_of.reshape(fixed.n_leaves, o))
        tables.append(of_leaves)
        row = code.read(row_bits, f"&{name}_leaves[leaf][k]")
    value = f"{name}_plus({code.read(offset_bits, f'{name}_row_offsets + row')}, {name}_rows[row], q)"
    if fixed.shifts.any():
        shift = str(int(rows[0, -1]))
        if (rows[:, -1] != rows[0, -1]).any():
            shifts, shift_bits = code.table("shifts", rows[:, -1])
            tables.append(shifts)
            shift = code.read(shift_bits, f"{name}_shifts + row")
        value = f"{name}_shifted({value}, {shift})"
    more, answered = _answer(fixed.head, code)
    index = "int" if fixed.n_leaves * o < 2**15 else "int32_t"
    declared = [f"    {code.sum_type} y[{o}];"] if code.gives_labels else []
    return [*tables, *more], [
        *declared,
        "    int k;",
        f"    for (k = 0; k < {o}; k++) {{",
        f"        const {index} row = {row};",
        f"        y[k] = {value};",
        "    }",
        *answered,
    ]


@singledispatch
def _answer(head: Head, code: FixedCode) -> tuple[list[Table], list[str]]:
    """Return tables, and the lines that make the answer of y."""
    raise no_entry(head, "to_c of a FixedPointTree")


@_answer.register
def _(head: Identity, code: FixedCode) -> tuple[list[Table], list[str]]:
    return [], []


@_answer.register
def _(head: ClipBox, code: FixedCode) -> tuple[list[Table], list[str]]:
    limits, tables, read = code.fixed.output_limits, list[Table](), list[str]()
    assert limits is not None
    for what, values in zip(("least", "most"), limits, strict=True):
        if (values == values[0]).all():
            read.append(str(int(values[0])))
        else:
            table, bits = code.table(what, values)
            tables.append(table)
            read.append(code.read(bits, f"{code.name}_{what} + k"))
    return tables, [
        f"    for (k = 0; k < {code.fixed.n_outputs}; k++) {{",
        f"        const {code.sum_type} low = {read[0]}, high = {read[1]};",
        "        y[k] = y[k] < low ? low : y[k] > high ? high : y[k];",
        "    }",
    ]


@_answer.register
def _(head: TanhBox, code: FixedCode) -> tuple[list[Table], list[str]]:
    table = code.fixed.table
    assert table is not None
    values, bits = code.table("tanh", table.values)
    step, n_steps = table.step_bits, table.values.shape[1] - 1
    half = (1 << step) >> 1
    row = f"{code.name}_tanh[{'0' if len(table.values) == 1 else 'k'}]"
    return [values], [
        f"    for (k = 0; k < {code.fixed.n_outputs}; k++) {{  /* tanh, linear between the numbers of a table */",
        f"        {code.sum_type} a = y[k] < 0 ? -y[k] : y[k], low, rise;",
        "        int step;",
        f"        if (a > {table.last})",
        f"            a = {table.last};",
        f"        step = (int)(a >> {step});",
        f"        if (step > {n_steps - 1})",
        f"            step = {n_steps - 1};",
        f"        a -= ({code.sum_type})step << {step};",
        f"        low = {code.read(bits, f'&{row}[step]')};",
        f"        rise = {code.read(bits, f'&{row}[step + 1]')} - low;",
        f"        low += (rise * a + {half}) >> {step};",
        "        y[k] = y[k] < 0 ? -low : low;",
        "    }",
    ]


@_answer.register
def _(head: Sign, code: FixedCode) -> tuple[list[Table], list[str]]:
    return [], ["    return y[0] > 0;"]


@_answer.register
def _(head: Argmax, code: FixedCode) -> tuple[list[Table], list[str]]:
    return [], [
        "    {",
        "        int best = 0;",
        f"        for (k = 1; k < {code.fixed.n_outputs}; k++)",
        "            if (y[k] > y[best])",
        "                best = k;",
        "        return best;",
        "    }",
    ]


def _self_test(code: FixedCode, states: IntArray) -> list[str]:
    """Return a main() that compares the answers to integers (n, d) with those of Python, under name_TEST."""
    fixed, name = code.fixed, code.name
    answers = fixed.predict_integers(states).reshape(len(states), -1)
    n_answers = answers.shape[1]
    tables = [
        *integer_declaration(code.input_type, f"{name}_states", states, ""),
        *integer_declaration(f"int{max(_bits_of(answers), 16)}_t", f"{name}_answers", answers, ""),
    ]
    if code.gives_labels:
        compared = [f"        n_wrong += {name}_label({name}_states[n]) != {name}_answers[n][0];"]
        declared = []
    else:
        declared = [f"    {code.sum_type} y[{n_answers}];", "    int k;"]
        compared = [
            f"        {name}({name}_states[n], y);",
            f"        for (k = 0; k < {n_answers}; k++)",
            f"            n_wrong += y[k] != {name}_answers[n][k];",
        ]
    return [
        "",
        f"#ifdef {name.upper()}_TEST  /* answers that are not those of Python: 0 of {len(states):,} states */",
        *tables,
        "",
        "int main(void)",
        "{",
        "    int n_wrong = 0, n;",
        *declared,
        f"    for (n = 0; n < {len(states)}; n++) {{",
        *compared,
        "    }",
        "    return n_wrong != 0;",
        "}",
        "#endif",
    ]


def _main(code: FixedCode) -> list[str]:
    """Return a main() that answers integers from the standard input, under name_MAIN."""
    d, o = code.fixed.n_inputs, 1 if code.gives_labels else code.fixed.n_outputs
    answered = f"y[0] = {code.name}_label(x);" if code.gives_labels else f"{code.name}(x, y);"
    least, most = (f"INT{code.fixed.input_bits}_{end}" for end in ("MIN", "MAX"))
    return [
        "",
        f"#ifdef {code.name.upper()}_MAIN  /* replace what reads by your sensors, what prints by your actuators */",
        "#include <stdio.h>",
        "",
        "int main(void)",
        "{",
        f"    {code.input_type} x[{d}];",
        f"    {code.sum_type} y[{o}];",
        "    long read;",
        "    int k;",
        "    for (;;) {",
        f"        for (k = 0; k < {d}; k++) {{",
        '            if (scanf("%ld", &read) != 1)',
        "                return 0;",
        f"            x[k] = ({code.input_type})(read < {least} ? {least} : read > {most} ? {most} : read);",
        "        }",
        f"        {answered}",
        f"        for (k = 0; k < {o}; k++)",
        f"            printf(\"%lld%c\", (long long)y[k], k < {o - 1} ? ' ' : '\\n');",
        "    }",
        "}",
        "#endif",
    ]
