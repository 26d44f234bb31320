"""A tree as a function block in structured text (IEC 61131-3), the language of programmable logic controllers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import singledispatch

import numpy as np

from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import Names, check_tree, give_labels, in_comment, label_name, names_for
from otr.programs.pid_gains import joined
from otr.programs.walk import MAX_NESTED_DEPTH, affine_expression, child, distinct_rows, summary_of, walk, wrapped

# IEC 61131-3 (2013), Table 4, without what has a digit, and words of the dialects; what ends a block of these; then the
# types, the standard functions that controllers know, and the block's own variables.
_KEYWORDS = """
    abstract action and and_then array at by case class configuration constant continue do else elsif en eno exit
    extends f_edge false final for from function function_block functionblock goto if implements initial_step interface
    internal interval jmp method mod namespace non_retain not null of on or or_else override overlap persistent pointer
    priority private program property protected public r_edge read_only read_write ref reference refto repeat resource
    retain return single step struct super task then this to transition true type union until using var var_access
    var_config var_external var_global var_in_out var_input var_inst var_output var_stat var_temp while with xor
"""
_ENDS = " ".join(f"end_{word}" for word in _KEYWORDS.split())
_TYPES = """
    any any_bit any_chars any_date any_derived any_elementary any_int any_magnitude any_num any_real any_string bit bool
    byte char date date_and_time dint dt dword int ldate ldate_and_time ldt lint lreal ltime ltime_of_day ltod lword
    real sint string time time_of_day tod udint uint ulint usint wchar word wstring
"""
_FUNCTIONS = """
    abs acos add adr asin atan concat cos ctd ctu ctud delete div dt eq exp expt f_trig find ge gt insert le left len
    limit ln log lt max mid min move mul mux ne now r_trig replace right rol ror rs sel shl shr sign sin sizeof sqrt sr
    sub tan tof ton tp trunc
"""
_OWN = "decay label best inputs tests test_of child label_of rows row_of node first total column"
_RESERVED = tuple(f"{_KEYWORDS} {_ENDS} {_TYPES} {_FUNCTIONS} {_OWN}".split())
_INDENT = "    "


def to_structured_text(
    tree: ObliqueTree,
    *,
    name: str = "policy",
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> str:
    """Return a FUNCTION_BLOCK (IEC 61131-3) that answers as ``tree.predict`` does, in LREAL.

    It has one VAR_INPUT a feature and one VAR_OUTPUT a component of the answer or, where the answers are labels, the
    one output ``label``. Tests are nested IFs; a tree deeper than 64 is tables and a WHILE. TANH is no standard
    function, so it is written through EXP, which then cannot overflow. Numbers are in their shortest exact form.

    Args:
        tree: any tree.
        name: what to call the block.
        feature_names, output_names: as in `to_text`; they become variables.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, names that are not distinct, or `name` is no identifier.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> otr.to_structured_text(tree).count("IF ")
        1
    """
    if not re.fullmatch(r"[A-Za-z](_?[A-Za-z0-9])*", name) or name.lower() in _RESERVED:
        raise ValueError(f"name is {name!r}, which cannot be the name of a function block")
    check_tree(tree)
    tree = merge_equal_leaves(tree)
    names = names_for(tree, feature_names, output_names, reserved=(*_RESERVED, name.lower()), ignore_case=True)
    nested = tree.depth <= MAX_NESTED_DEPTH
    declarations, statements = _nested(tree, names) if nested else _tables(tree, names)
    head_variables, head = answer_statements(tree.head, names) if tree.labels is None else ([], [])
    lines = [f"(* {name}: {summary_of(tree)}. *)", f"FUNCTION_BLOCK {name}"]
    lines += _section("VAR_INPUT", map(_declared, names.feature_ids, names.features))
    lines += _section("VAR_OUTPUT", _outputs(tree, names))
    lines += _section("VAR CONSTANT", declarations.get("VAR CONSTANT", []))
    lines += _section("VAR", [*declarations.get("VAR", []), *head_variables])
    return "\n".join([*lines, "", *statements, *head, "END_FUNCTION_BLOCK"]) + "\n"


def number(value: float) -> str:
    """Return a real literal of exactly this float64: digits, a point, digits, perhaps an exponent."""
    mantissa, _, exponent = repr(float(value)).partition("e")
    point = "" if "." in mantissa else ".0"
    return f"{mantissa}{point}{f'E{int(exponent):+d}' if exponent else ''}"


def _section(kind: str, declarations: Iterable[str]) -> list[str]:
    lines = [line for declared in declarations for line in wrapped(declared, _INDENT)]
    return [kind, *lines, "END_VAR"] if lines else []


def _declared(identifier: str, name: str) -> str:
    return f"{identifier} : LREAL;{_comment(name, identifier)}"


def _comment(name: str, identifier: str) -> str:
    return "" if name == identifier else f" (* {in_comment(name)} *)"


def _outputs(tree: ObliqueTree, names: Names) -> list[str]:
    if give_labels(tree):
        return [f"label : {_integer_type(tree)};"]
    return list(map(_declared, names.answer_ids, names.answers))


def _integer_type(tree: ObliqueTree) -> str:
    largest = int(np.abs(tree.labels).max()) if tree.labels is not None else 0
    return "INT" if largest < 2**15 else "DINT" if largest < 2**31 else "LINT"


def _locals(tree: ObliqueTree, names: Names) -> list[str]:
    """Return the declarations of outputs that are only steps towards the answer."""
    if tree.labels is None and (give_labels(tree) or not tree.head.acts_by_output):
        return [f"{', '.join(names.output_ids)} : LREAL;"]
    return []


def _nested(tree: ObliqueTree, names: Names) -> tuple[dict[str, list[str]], list[str]]:
    """Return declarations by section, and the statements that assign the outputs or the label."""
    lines: list[str] = []
    for what, index, depth in walk(tree):
        indent = _INDENT * depth
        if what == "if":
            test = affine_expression(tree.P[index], float(tree.v[index]), names.feature_ids, number)
            lines += wrapped(f"IF {test} <= 0.0 THEN", indent)
        elif what in ("else", "end"):
            lines.append(f"{indent}{'ELSE' if what == 'else' else 'END_IF;'}")
        elif tree.labels is not None:
            label = int(tree.labels[index])
            comment = _comment(label_name(label, names.answers), str(label))
            lines.append(f"{indent}label := {label};{comment}")
        else:
            for output, identifier in enumerate(names.output_ids):
                offset = float(tree.c[index, output])
                value = affine_expression(tree.M[index, output], offset, names.feature_ids, number)
                lines += wrapped(f"{identifier} := {value};", indent)
    return {"VAR": _locals(tree, names)}, lines


def _tables(tree: ObliqueTree, names: Names) -> tuple[dict[str, list[str]], list[str]]:
    """Return the same as `_nested` with the tests and leaves in tables, found by a loop."""
    d, o = tree.n_inputs, tree.n_outputs
    tests, test_of = distinct_rows(tree.test_forms)
    constants = [_reals("tests", tests), _integers("test_of", test_of), _integers("child", child(tree))]
    variables = [f"inputs : ARRAY [0..{d - 1}] OF LREAL;", "node, first, column : DINT;", "total : LREAL;"]
    lines = [f"inputs[{i}] := {identifier};" for i, identifier in enumerate(names.feature_ids)]
    lines += [
        "(* A row of tests is its weights, then its offset; a negative child is the leaf -1 - child. *)",
        "node := 0;",
        "WHILE node >= 0 DO",
        *_sum_of_row("tests", "test_of[node]", d, _INDENT),
        "    IF total <= 0.0 THEN",
        "        node := child[2 * node];",
        "    ELSE",
        "        node := child[2 * node + 1];",
        "    END_IF;",
        "END_WHILE;",
        "node := -1 - node;",
    ]
    if tree.labels is not None:
        constants.append(_integers("label_of", tree.labels, _integer_type(tree)))
        return {"VAR CONSTANT": constants, "VAR": variables}, [*lines, "label := label_of[node];"]
    rows, row_of = distinct_rows(tree.leaf_forms.reshape(-1, d + 1))
    constants += [_reals("rows", rows), _integers("row_of", row_of)]
    for output, identifier in enumerate(names.output_ids):
        lines += [*_sum_of_row("rows", f"row_of[{o} * node + {output}]", d, ""), f"{identifier} := total;"]
    return {"VAR CONSTANT": constants, "VAR": [*variables, *_locals(tree, names)]}, lines


def _sum_of_row(table: str, row: str, n_inputs: int, indent: str) -> list[str]:
    """Return the statements that compute `total`, a row's weights times x plus its offset."""
    return [
        f"{indent}first := {n_inputs + 1} * {row};",
        f"{indent}total := {table}[first + {n_inputs}];",
        f"{indent}FOR column := 0 TO {n_inputs - 1} DO",
        f"{indent}    total := total + {table}[first + column] * inputs[column];",
        f"{indent}END_FOR;",
    ]


def _reals(table: str, values: np.ndarray) -> str:
    text = ", ".join(map(number, values.ravel().tolist()))
    return f"{table} : ARRAY [0..{values.size - 1}] OF LREAL := [{text}];"


def _integers(table: str, values: np.ndarray, kind: str = "DINT") -> str:
    text = ", ".join(map(str, values.ravel().tolist()))
    return f"{table} : ARRAY [0..{values.size - 1}] OF {kind} := [{text}];"


@singledispatch
def answer_statements(head: Head, names: Names) -> tuple[list[str], list[str]]:
    """Return the variables and the statements that make the answer under a head of the outputs."""
    raise no_entry(head, "to_structured_text")


@answer_statements.register
def _(head: Identity, names: Names) -> tuple[list[str], list[str]]:
    return [], []


@answer_statements.register
def _(head: Exp, names: Names) -> tuple[list[str], list[str]]:
    return [], [f"{output} := EXP({output});" for output in names.output_ids]


@answer_statements.register
def _(head: ClipBox, names: Names) -> tuple[list[str], list[str]]:
    outputs = names.output_ids
    limits = zip(outputs, *(limit.tolist() for limit in head.limits(len(outputs))), strict=True)
    return [], [f"{output} := LIMIT({number(low)}, {output}, {number(high)});" for output, low, high in limits]


@answer_statements.register
def _(head: TanhBox, names: Names) -> tuple[list[str], list[str]]:
    return _squashed(head, names)


@answer_statements.register
def _(head: PidBox, names: Names) -> tuple[list[str], list[str]]:
    controls = zip(names.answer_ids, joined(names.output_ids, len(names.answers)), strict=True)
    lines = [line for answer, control in controls for line in wrapped(f"{answer} := {control};", "")]
    variables, squashed = _squashed(head, names)
    return variables, [*lines, *squashed]


@answer_statements.register
def _(head: Sign, names: Names) -> tuple[list[str], list[str]]:
    return [], [f"IF {names.output_ids[0]} > 0.0 THEN", "    label := 1;", "ELSE", "    label := 0;", "END_IF;"]


@answer_statements.register
def _(head: Argmax, names: Names) -> tuple[list[str], list[str]]:
    first, *others = names.output_ids
    lines = ["label := 0;", f"best := {first};"]
    for i, output in enumerate(others, start=1):
        lines += [f"IF {output} > best THEN", f"    label := {i};", f"    best := {output};", "END_IF;"]
    return ["best : LREAL;"], lines


def _squashed(head: TanhBox | PidBox, names: Names) -> tuple[list[str], list[str]]:
    """Return the variable and the statements that squash every answer in its own variable."""
    halves, middles = (part.tolist() for part in head.halves_and_middles(len(names.output_ids)))
    lines = ["(* tanh(u) = (1 - decay) / (1 + decay) with the sign of u, where decay = exp(-2 |u|). *)"]
    for answer, half, middle in zip(names.answer_ids, halves, middles, strict=True):
        lines += [
            f"decay := EXP(-2.0 * ABS({answer}));",
            f"IF {answer} < 0.0 THEN",
            f"    {answer} := {_scaled('(decay - 1.0) / (1.0 + decay)', half, middle)};",
            "ELSE",
            f"    {answer} := {_scaled('(1.0 - decay) / (1.0 + decay)', half, middle)};",
            "END_IF;",
        ]
    return ["decay : LREAL;"], lines


def _scaled(ratio: str, half: float, middle: float) -> str:
    product = ratio if half == 1 else f"{number(half)} * {ratio}"
    return product if middle == 0 else f"{number(middle)} + {product}"
