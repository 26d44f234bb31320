"""What is no program is refused at its place, in words that say what to do."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr

NAMES = ["position", "velocity", "left contact"]

REFUSED = [
    # text, line, column, words
    ("", 1, 1, "the program is empty"),
    ("# nothing\n\n", 1, 1, "the program is empty"),
    ("return velocty", 1, 8, "unknown name 'velocty'. Did you mean velocity?"),
    ("return Position", 1, 8, "Did you mean position?"),
    ("return speed", 1, 8, "unknown name 'speed'. Known are: position, velocity, left contact"),
    ("return u\nu = 1", 1, 8, "unknown name 'u'"),
    ("return sin(velocity)", 1, 8, "unknown function 'sin'. Did you mean min?"),
    ("return position (velocity)", 1, 8, "'position' is no function; write position * (...)"),
    ("return position * velocity", 1, 17, "multiplies two values that depend on the inputs"),
    ("u = 2 position\nreturn 3 * u * (velocity + 1)", 2, 14, "one factor must be constant"),
    ("return 1 / velocity", 1, 10, "divides by a value that depends on the inputs"),
    ("return velocity / (1 - 1)", 1, 17, "this divides by zero"),
    ("return velocity ^ 2", 1, 17, "powers are not affine"),
    ("return velocity**2", 1, 16, "powers are not affine"),
    ("return 1/2 velocity", 1, 12, "Write a / b * velocity or a / (b * velocity)"),
    ("return 1e999", 1, 8, "larger than a float64 can hold"),
    ("return 1e300 * 1e300 * velocity", 1, 14, "grow larger than a float64 can hold"),
    ("return clip(velocity, 1, -1)", 1, 8, "clip's limits are 1 and -1, lower first"),
    ("return clip(velocity, 1)", 1, 8, "clip takes 3 arguments, got 2"),
    ("return abs(velocity, 1)", 1, 8, "abs takes 1 argument, got 2"),
    ("return tanh(velocity) + position", 1, 23, "tanh may only be scaled and shifted by constants"),
    ("if tanh(velocity) > 0 then 1 else 0", 1, 4, "tanh may only be scaled"),
    ("if velocity > 0 then tanh(velocity) else 2 tanh(position)", 1, 42, "where one answer goes through tanh all must"),
    ("if velocity > 0 then tanh(velocity) else 1", 1, 42, "where one answer goes through tanh all must"),
    ("return argmax(velocity, 1)", 1, 8, "labels=True reads labels"),
    ("if velocity <= 0 then return 1", 1, 1, "come to its end without an answer; add an 'else'"),
    ("if velocity <= 0:\n    u = 1\nelse:\n    return 2\n", 2, 5, "without an answer"),
    ("if velocity <= 0:\n    y0 = 1\n    y1 = 2\nelse:\n    y0 = 3", 5, 5, "give no value to the output 'y1'"),
    ("y1 = 2 position\ny2 = 3 position", 2, 1, "the output 'y2' has a value and 'y0' has none; number the outputs"),
    ("y0 = position\nu = 1\ny2 = 3 u", 3, 1, "the output 'y2' has a value and 'y1' has none; number the outputs"),
    ("y0 = position\ny01 = 3", 2, 1, "the output 'y01' has a value and 'y1' has none; number the outputs"),
    ("if velocity <= 0:\n    u = 1\nreturn u", 3, 8, "'u' has no value on some ways to here"),
    ("if velocity <= 0 return 1", 1, 18, "expected 'then' or ':' after the condition, found 'return'"),
    ("if velocity <= 0\n    -1\nelse\n    1", 2, 7, "expected 'then' or ':' after the condition, found the end of"),
    ("if velocity then 1 else 2", 1, 4, "this is a number where a condition was expected"),
    ("if velocity = 0 then 1 else 2", 1, 13, "to compare, write '=='"),
    ("if not velocity then 1 else 2", 1, 8, "this is a number where a condition was expected"),
    ("return velocity <= 0", 1, 17, "this is a condition where a number was expected"),
    ("if (velocity <= 0) -1 else 1", 1, 14, "is 'then' missing"),
    ("return 1 if velocity > 0", 1, 25, "expected 'else' after the condition, for the other value, found the end"),
    ("return 1 if velocity > 0\nelse 0", 1, 25, "found the end of the line"),
    ("else\n    return 1", 1, 1, "'else' without an 'if'"),
    ("return 1\nreturn 2", 2, 1, "nothing reaches this: line 1 has answered"),
    ("if velocity > 0: return 1\nelse: return 2\nu = 1", 3, 1, "nothing reaches this"),
    ("return 1 2", 1, 10, "unexpected '2' after a statement"),
    ("return velocity position", 1, 17, "unexpected 'position' after a statement; write * for"),
    ("return 1\n}", 2, 1, "unexpected '}'"),
    ("return (1 + velocity", 1, 21, "expected ')' to close the bracket of line 1, column 8, found the end of the text"),
    ("return 1 +", 1, 11, "expected a number, a name or '(', found the end"),
    ("return 1 +\nreturn 2", 1, 11, "found the end of the line"),
    ("return @", 1, 8, "the character '@' has no meaning here"),
    ("u = 1\n    w = 2\nreturn u", 2, 5, "this line is indented unlike those around it"),
    ("if velocity > 0:\n    u = 1\n  w = 2\nreturn 1", 3, 3, "this line is indented unlike"),
    ("if velocity > 0:\n\tu = 1\nelse:\n    u = 2\nreturn u", 4, 1, "tabs and spaces indent"),
    ("if velocity > 0 then\nu = 1\nw = 2", 1, 1, "where does the block of this 'if' end?"),
    ("if velocity > 0 then {\nreturn 1\n", 2, 9, "expected '}' for the brace of line 1"),
    ("if velocity > 0 then {} else 1", 1, 23, "expected a statement between the braces"),
    ("if velocity > 0 then else 1", 1, 22, "expected a statement for 'if', found 'else'"),
    ("velocity = 3\nreturn velocity", 1, 1, "'velocity' is an input"),
    ("y0 = 1\ny0 = velocity", 2, 1, "'y0' has a value from line 1 that nothing has used"),
    ("if velocity > 0 then return 1, 2 else return 3", 1, 46, "this answer has 1 values, expected 2"),
    ("return " + "(" * 200 + "1" + ")" * 200, 1, 108, "more than 100 brackets and operators"),
    ("return " + "-" * 300 + "1", 1, 109, "more than 100 brackets and operators"),
    ("return " + "if velocity > 0 then " * 350 + "1" + " else 2" * 350, 1, 2122, "more than 100 brackets"),
    ("return " + "1 if velocity > 0 else " * 350 + "1", 1, 2324, "more than 100 brackets and operators"),
    ("if velocity > 0 then {" * 5000, 1, 110001, "expected '}' for the brace of line 1, found the end of the text"),
    ("if velocity > 0:\n" * 5000 + "1", 4999, 1, "where does the block of this 'if' end?"),
    ("return `velocity", 1, 8, "the character '`' has no meaning here"),
    ("return `veloc\\u{69}t`", 1, 8, "unknown name 'velocit'. Did you mean velocity?"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "column", "words"), REFUSED, ids=[row[0][:40] for row in REFUSED])
def test_what_is_refused_where_and_why(text: str, line: int, column: int, words: str) -> None:
    with pytest.raises(otr.ProgramError) as caught:
        otr.parse_program(text, NAMES)
    error = caught.value
    assert words in error.reason
    assert (error.line, error.column) == (line, column)
    assert str(error).startswith(f"line {line}, column {column}: ")


@pytest.mark.parametrize(
    ("text", "column", "words"),
    [
        ("return velocity", 8, "depends on the inputs where a label was expected"),
        ("return 0.5", 8, "0.5 is no label; labels are 0 to 1, or coast, fire"),
        ("return 2", 8, "2 is no label"),
        ("return -1", 8, "-1 is no label"),
        ("return fire, coast", 8, "this answer has 2 values, expected 1"),
        ("return fir", 8, "Did you mean fire?"),
        ("fire = velocity", 1, "without an answer"),
    ],
)
def test_labels_that_are_none(text: str, column: int, words: str) -> None:
    with pytest.raises(otr.ProgramError) as caught:
        otr.parse_program(text, NAMES, labels=True, output_names=["coast", "fire"])
    assert words in caught.value.reason
    assert caught.value.column == column


def test_a_label_without_labels_says_what_to_give() -> None:
    with pytest.raises(otr.ProgramError, match=r"unknown name 'fire'. It is an output's.*for labels, give labels=True"):
        otr.parse_program("return fire", NAMES, output_names=["coast", "fire"])


def test_an_error_shows_the_line_and_a_caret_below_the_place() -> None:
    with pytest.raises(otr.ProgramError) as caught:
        otr.parse_program("u = 1\nif u > 0:\n\treturn u * velocty # a slip\n", ["velocity"])
    assert str(caught.value) == (
        "line 3, column 13: unknown name 'velocty'. Did you mean velocity?\n"
        "    \treturn u * velocty # a slip\n"
        "    \t           ^"
    )


def test_an_error_survives_its_way_from_a_worker() -> None:
    with pytest.raises(otr.ProgramError) as caught:
        otr.parse_program("return 1 +", NAMES)
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.line, copy.column) == (str(caught.value), 1, 11)


PIECES = st.sampled_from([
    "if", "then", "else", "elif", "end", "return", "and", "or", "not", "(", ")", "{", "}", "[", "]", ",", ";", ":",
    "=", "==", "<=", ">", "+", "-", "*", "/", "^", "1", "2.5", "1e999", "position", "velocity", "u", "y0", "max",
    "min(", "clip(", "tanh(", "argmax(", "abs(", "#", "é",
    "left contact", " ", "\n", "\n    ", "\n\t",
])  # fmt: skip


@settings(max_examples=400)
@given(st.lists(PIECES, max_size=25), st.booleans())
def test_whatever_the_text_a_tree_or_an_error_with_its_place(pieces: list[str], labels: bool) -> None:
    text = " ".join(pieces)
    try:
        tree = otr.parse_program(text, NAMES, labels=labels, max_leaves=64)
    except otr.ProgramError as error:
        lines = text.split("\n")
        assert 1 <= error.line <= len(lines)
        assert 1 <= error.column <= len(lines[error.line - 1]) + 1
        assert error.source_line == lines[error.line - 1]
    except otr.TreeTooLargeError:
        pass
    else:
        tree.check()


# The longest ways that the reader, and what evaluates, call themselves by.
CYCLES = [
    ("(", ")"), ("2 (", ")"), ("max(1, ", ")"), ("2 clip(0, ", ", 1)"), ("2 clip(", ", 0, 1)"), ("1 + 2 * (", ")"),
    ("(1 if 0 < ", " else 0)"), ("(1 if position<0 or position>1 and not 0 < 1+2*", " else 0)"), ("-", ""), ("[", "]"),
    ("if 0 < ", " then 1 else 2"), ("max(2 clip(0, 1 + (1 if 0 < ", " else 0), 1), 2)"), ("argmax(0, ", ")"),
    ("if position > 0 then ", " else 1"), ("1 if velocity > 0 else ", ""), ("if position > 0:\n", ""), ("not (", ")"),
    ("if position > 0 then 1 elif velocity > ", ""),
]  # fmt: skip


@settings(max_examples=100)
@given(
    st.sampled_from(CYCLES), st.integers(1, 400), st.sampled_from(["return ", "u = ", "if ", ""]), st.integers(0, 200)
)
def test_nesting_never_meets_pythons_own_limit(cycle: tuple[str, str], n: int, start: str, n_calls: int) -> None:
    opening, closing = cycle

    def parse(n_calls: int) -> otr.ObliqueTree:
        if n_calls:
            return parse(n_calls - 1)
        return otr.parse_program(f"{start}{opening * n}position{closing * n}", NAMES, max_leaves=256)

    try:
        parse(n_calls).check()
    except (otr.ProgramError, otr.TreeTooLargeError) as error:
        assert str(error)


def test_too_many_paths() -> None:
    text = "u = 0\n" + "\n".join(f"u = u + max(position, {i} velocity)" for i in range(1, 20)) + "\nreturn u"
    with pytest.raises(otr.TreeTooLargeError, match=r"line \d+: the program has more than 256 leaves"):
        otr.parse_program(text, NAMES, max_leaves=256)
    assert otr.parse_program("return max(position, velocity)", NAMES, max_leaves=2).n_leaves == 2
    with pytest.raises(otr.TreeTooLargeError, match="line 1"):
        otr.parse_program("return max(position, velocity)", NAMES, max_leaves=1)


@pytest.mark.parametrize(
    ("features", "outputs", "words"),
    [
        (["x", "x"], None, "feature_names has 'x' twice"),
        (["x"], ["y", "y"], "output_names has 'y' twice"),
        (["x"], ["x"], "output_names has 'x', which is an input's name, too"),
        ("xy", None, "feature_names is the text 'xy', expected a list of names"),
    ],
)
def test_names_that_no_program_could_use(features: list[str], outputs: list[str] | None, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        otr.parse_program("return 1", features, output_names=outputs)


def test_a_program_without_an_answer_is_told_the_names_of_the_outputs() -> None:
    with pytest.raises(otr.ProgramError, match="or give a value to force"):
        otr.parse_program("action = 1", ["v"], output_names=["force"])
    with pytest.raises(otr.ProgramError, match=r"or give values to y0, y1, \.\.\."):
        otr.parse_program("action = 1", ["v"])


def test_what_is_no_text_is_told() -> None:
    with pytest.raises(TypeError, match="text is a int, expected the program as a str"):
        otr.parse_program(3, ["v"])  # type: ignore[arg-type]


def test_a_number_that_may_be_another_label_s_name_is_refused() -> None:
    classes = ["1", "2", "3"]
    with pytest.raises(otr.ProgramError, match="1 is the name of a label; write it as `1`, as a name"):
        otr.parse_program("if position <= 0: 1 else: 2", NAMES, labels=True, output_names=classes)
    tree = otr.parse_program("if position <= 0: `1` else: 0", NAMES, labels=True, output_names=classes)
    assert tree.predict(np.array([[-1.0] + [0.0] * (len(NAMES) - 1)])).tolist() == [0]
    assert otr.parse_program("return 1", NAMES, labels=True, output_names=["0", "1"]).labels.tolist() == [1]
