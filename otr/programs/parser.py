"""Programs read: from the text that `to_text` writes, or a person, to the tree that computes the same."""

from __future__ import annotations

from collections.abc import Sequence

from otr.core.tree import ObliqueTree
from otr.programs.language.cursor import Cursor
from otr.programs.language.foreign import in_our_words
from otr.programs.language.lowering import Lowering
from otr.programs.language.meanings import check_statements, check_tokens, is_c
from otr.programs.language.scope import FUNCTIONS, Scope
from otr.programs.language.statements import read_program
from otr.programs.language.tokens import Source, check_indentation, tokenize
from otr.programs.names import check_names


def parse_program(
    text: str,
    feature_names: Sequence[str],
    *,
    output_names: Sequence[str] | None = None,
    labels: bool = False,
    max_leaves: int = 2**16,
) -> ObliqueTree:
    """Return the tree that computes what a program says: the way back from `to_text`, for programs by hand, too.

        u = 3 velocity                        # names for values; a later `if` sees what an earlier one has set
        if u > 1 and position <= 0.5 then
            return clip(2 u - position / 4, -1, 1)
        else
            return -1

    Values are affine: numbers, inputs and names under ``+ - * /``, as far as one factor, and the divisor, is constant;
    ``2 x`` is ``2 * x``. ``max``, ``min``, ``clip``, ``abs`` and ``a if condition else b`` may occur anywhere, because
    they are tests. Conditions compare (``< <= > >= == !=``, chains as ``0 < x <= 1``) and join with ``and or not``.
    A program answers with ``return``, with a value alone, or at its end with the values of its outputs,
    ``name = value``. A block is what is indented, what is on the line, or what is in braces; ``then``, ``:`` and
    brackets as in C may follow a condition; ``#`` begins a comment, and so does ``//``, except after a value in text
    without braces and semicolons, where Python divides. A name that is no word may be put between backquotes, as
    `to_text` writes it: ``2 `50% quantile` ``; there a backslash and a backquote have a backslash before them, and
    ``\\u{a}`` is the character of that code.

    What others print is read, too: a function of C or Python with its inputs as ``x[0]`` and numbers as ``3.0f``, and
    trees of scikit-learn (`export_text`, `export_graphviz`) and dtControl (C and DOT), with their numbers as printed,
    not rounded to float. Text with semicolons and without ``:``, ``then`` or ``end`` is taken for C. What C or Python
    computes otherwise than this language is refused: in C ``1/2``, ``0 < x < 1``, ``!x <= 0``, a comma, `abs`, and
    variables and answers of an integer type that are no integers.

    Every way through the program is a path of the tree: a statement after an `if` is there once for each way through
    it, and what `max` or `and` decides is a test. All tests are ``P @ x + v <= 0``, with the boundary on the side that
    the program's own sign has it. Tests without an input, and those that a path has made before, are left out.
    Coefficients are added up in float64.

    Where all answers of every output are clipped to the same constants, the tree has the head `ClipBox` and no tests
    for it; a constant answer within them counts as clipped. Where all are ``constant + constant * tanh(...)``, alike in
    every leaf, the head is `TanhBox`, and where all are ``exp(...)`` it is `Exp`. Other trees have no head, and their
    clips are tests.

    Args:
        text: the program.
        feature_names: names of the d inputs, in order.
        output_names: names of the outputs, or with `labels` of the labels, as in `to_text`. Without them the outputs
            are y0, y1, ... without a gap, as many as the program answers with, and labels are numbers only.
        labels: the program answers labels: a number, a name, or ``argmax(...)``, where a tie goes to the first. The
            tree's outputs are then 1 for the leaf's label, else 0.
        max_leaves: refuse a program that needs more; paths multiply with every `if` that is not the last.

    Returns:
        The tree, with the tests in the order in which the program makes them.

    Raises:
        ProgramError: the text is no program, or means something else in C or Python; has the line and the column.
        TreeTooLargeError: names the line at which there were too many paths.
        TypeError: `text` is no text.
        ValueError: a name is given twice.

    Examples:
        >>> tree = otr.parse_program("if x + 2 v <= 0: 1 else: clip(x, -1, 1)", ["x", "v"])
        >>> tree.predict([3, 0])
        array([1.])
    """
    if not isinstance(text, str):
        raise TypeError(f"text is a {type(text).__name__}, expected the program as a str")
    if max_leaves < 1:
        raise ValueError(f"max_leaves is {max_leaves}, expected at least 1")
    check_names(feature_names, output_names or ())
    translation = in_our_words(text, feature_names, output_names)
    source = Source(translation.text)
    tokens = tokenize(source, [*feature_names, *(output_names or ())], FUNCTIONS)
    of_c = is_c(tokens, translation)
    if not of_c:
        check_indentation(source, tokens)
    check_tokens(source, tokens, of_c)
    label_names = {name: label for label, name in enumerate(output_names or ())} if labels else {}
    scope = Scope(source, feature_names, label_names, () if labels else output_names or ())
    block = read_program(Cursor(source, tokens), scope)
    check_statements(source, block, translation, label_names, of_c)
    return Lowering(source, scope, len(feature_names), output_names, labels, max_leaves).tree(block)
