"""A tree as the nested if-then-else program in which the thesis prints its policies."""

from __future__ import annotations

from collections.abc import Sequence

from otr.core.tree import ObliqueTree, require_tree
from otr.programs.language.tokens import written
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import names_of
from otr.programs.notation import Notation, Program

_INDENT = "    "


def to_text(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 4,
) -> str:
    """Return the program of `tree`, as in Orfanos 2023, Fig. 4.2, without tests whose two sides answer the same.

        if -2.2 - 3.8 x + 114.3 v <= 0 then
            return -6.1
        else
            return -102.3 - 169.8 x + 5116.5 v

    Several outputs take one line each, ``name = expression``. Coefficients that are zero are left out. A PID policy's
    leaf states its gains first (`otr.PidBox`), as in Fig. 4.4; the program begins with what P, I and D are. A
    name that is not made of words is put between backquotes, where `parse_program` reads it back whatever it holds.

    Args:
        tree: any tree.
        feature_names: d names, no two the same, and none that an output has, too; the tree's own if None, or x0, x1,
            ... where it has none.
        output_names: names of the outputs, likewise, or y0, y1, ...; in a tree with labels, names of the labels.
        precision: significant digits, at least 1; 17 loses nothing.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, names that are not distinct, precision < 1, or a PID policy whose terms
            differ between leaves.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> print(otr.to_text(tree, feature_names=["angle"], output_names=["torque"]))
        if angle <= 0 then
            return -angle
        else
            return angle
    """
    require_tree(tree)
    return text_of_every_leaf(
        merge_equal_leaves(tree), feature_names=feature_names, output_names=output_names, precision=precision
    )


def text_of_every_leaf(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 4,
) -> str:
    """Return the program of `to_text` with every test of the tree, as `to_text` wrote it before it merged leaves."""
    features, answers = names_of(tree, feature_names, output_names)
    is_number = [tree.labels is not None and name == str(label) for label, name in enumerate(answers)]
    answers = [name if own else written(name) for name, own in zip(answers, is_number, strict=True)]
    program = Program(tree, _TEXT, [written(name) for name in features], answers, answers, precision)
    return "".join(f"{_INDENT * depth}{line}\n" for depth, line in program.lines())


def _vector(name: str, entries: Sequence[str], one_a_line: bool) -> list[str]:
    if one_a_line:
        return [f"{name} = [", *(f"    {entry}," for entry in entries), "]"]
    return [f"{name} = [{', '.join(entries)}]"]


_TEXT = Notation(
    number=lambda value, precision: f"{value:.{precision}g}",
    vector=_vector,
    times=" ",
    test="if %s <= 0 then",
    otherwise="else",
    returned="return %s",
    label="return %s",
    sign="return 1 if %s > 0 else 0",
    argmax="return argmax(%s)",
    assigned="%s = %s",
    clip="clip(%s, %s, %s)",
    exp="exp(%s)",
    tanh="tanh(%s)",
    product="%s . %s",
    gain="theta_%s",
    gain_of="theta_%s_%s",
)
