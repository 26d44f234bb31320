"""A tree as a graph in Graphviz's language, with the same boxes as the picture that `draw_tree` makes."""

from __future__ import annotations

import html
from collections.abc import Sequence

from otr.core.tree import ObliqueTree
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import check_tree, shown_names
from otr.programs.picture.boxes import NodeBox, tree_boxes
from otr.programs.picture.branches import look
from otr.programs.picture.formulas import Style
from otr.programs.picture.head_notes import head_note


def to_dot(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 2,
    max_terms: int = 3,
    max_depth: int | None = None,
) -> str:
    """Return a digraph for Graphviz: tests in round boxes, left where they hold (yes), leaves in colour.

    A test shows its largest terms, a leaf its label, its answer or its formulas, as in `draw_tree`; unlike there, a
    tree may have any number of leaves. ``dot -Tsvg tree.dot -o tree.svg`` draws it.

    Args:
        tree: any tree.
        feature_names, output_names: as in `to_text`.
        precision: significant digits, at least 1.
        max_terms: terms shown of a test or of a leaf's output, those with the largest coefficients; at least 1.
        max_depth: tests below this depth are folded up; None folds nothing.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, names that are not distinct, or a number out of its range.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> otr.to_dot(tree).splitlines()[0]
        'digraph policy {'
    """
    check_tree(tree)
    tree = merge_equal_leaves(tree)
    style = Style(*shown_names(tree, feature_names, output_names), precision, max_terms)
    boxes = tree_boxes(tree, style, None, max_depth)
    note = head_note(tree)
    lines = [
        "digraph policy {",
        '    graph [fontname="Helvetica", fontsize=9, ranksep=0.4, nodesep=0.2'
        + (f', label="{_quoted(note)}"];' if note else "];"),
        '    node [fontname="Helvetica", fontsize=10, shape=box];',
        '    edge [fontname="Helvetica", fontsize=9, color="#9aa5b1", arrowsize=0.6];',
    ]
    lines += [f"    n{i} [{_attributes(box)}];" for i, box in enumerate(boxes)]
    for i, box in enumerate(boxes):
        for to, word in zip(box.children, ("yes", "no"), strict=False):
            lines.append(f'    n{i} -> n{to} [label="{word}"];')
    return "\n".join([*lines, "}"]) + "\n"


def _attributes(box: NodeBox) -> str:
    line, fill, _ = look(box)
    style = "rounded,filled" if box.kind == "test" else "filled"
    shape = ", shape=folder" if box.kind == "subtree" else ""
    return f'label=<{_table(box)}>, style="{style}"{shape}, color="{line}", fillcolor="{fill}"'


def _table(box: NodeBox) -> str:
    """Return a box's lines as Graphviz's table: numbers flush right, next to what they multiply."""
    rows = [f'<TR><TD COLSPAN="2"><B>{html.escape(box.title)}</B></TD></TR>'] if box.title else []
    for row in box.rows:
        if isinstance(row, str):
            rows.append(f'<TR><TD COLSPAN="2" ALIGN="LEFT"><B>{html.escape(row)}</B></TD></TR>')
        elif row[0]:
            number, name = map(html.escape, row)
            rows.append(f'<TR><TD ALIGN="RIGHT">{number}</TD><TD ALIGN="LEFT">{name}</TD></TR>')
        else:
            rows.append(f'<TR><TD COLSPAN="2" ALIGN="RIGHT">{html.escape(row[1])}</TD></TR>')
    return f'<TABLE BORDER="0" CELLSPACING="0" CELLPADDING="1">{"".join(rows)}</TABLE>'


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')
