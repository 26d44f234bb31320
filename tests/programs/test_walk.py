import keyword

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.programs.names import identifiers, one_line
from otr.programs.walk import distinct_rows, in_printed_order, walk, wrapped
from tests.core.test_tree import random_tree
from tests.programs.policies import chain


@pytest.mark.parametrize(
    ("names", "made"),
    [
        (["z", "x_velocity", "T2"], ["z", "x_velocity", "T2"]),
        (["x velocity", "x-velocity"], ["x_velocity", "x_velocity_2"]),
        (["x velocity", "x_velocity"], ["x_velocity_2", "x_velocity"]),
        (["Höhe", "2nd", "%", "_a__b_"], ["Hohe", "v_2nd", "v2", "a_b"]),
        (["if", "a", "a"], ["if_2", "a", "a_2"]),
        (["a_2", "a", "a"], ["a_2", "a", "a_3"]),
    ],
)
def test_identifiers(names: list[str], made: list[str]) -> None:
    assert identifiers(names, [f"v{i}" for i in range(len(names))], reserved=["if"]) == made


def test_identifiers_that_differ_in_case_alone() -> None:
    assert identifiers(["Z", "z", "IF"], ["a", "b", "c"], reserved=["if"], ignore_case=True) == ["Z", "z_2", "IF_2"]


@given(
    st.lists(st.text(max_size=6) | st.sampled_from(["a", "A", "a_2", "if", "x y", "x_y"]), max_size=8), st.booleans()
)
def test_identifiers_are_distinct_and_valid(names: list[str], ignore_case: bool) -> None:
    made = identifiers(names, [f"v{i}" for i in range(len(names))], reserved=keyword.kwlist, ignore_case=ignore_case)
    assert all(name.isidentifier() and name.isascii() and not keyword.iskeyword(name) for name in made)
    assert not any("__" in name or name.endswith("_") for name in made)
    assert len({name.lower() if ignore_case else name for name in made}) == len(names)


def test_a_name_in_a_comment_is_one_line() -> None:
    assert one_line("a\nb\t c\u2028d\x00") == "a b c d"


def test_the_walk_writes_nested_ifs() -> None:
    events = list(walk(chain(2)))
    assert events == [
        ("if", 0, 0), ("leaf", 0, 1), ("else", 0, 0),
        ("if", 1, 1), ("leaf", 1, 2), ("else", 1, 1), ("leaf", 2, 2), ("end", 1, 1),
        ("end", 0, 0),
    ]  # fmt: skip
    assert len(list(walk(chain(10_000)))) == 40_001


def test_distinct_rows_keep_their_order() -> None:
    rows = np.array([[3.0, 1.0], [0.0, 2.0], [3.0, 1.0], [-1.0, 0.0]])
    unique, index = distinct_rows(rows)
    np.testing.assert_array_equal(unique, rows[[0, 1, 3]])
    np.testing.assert_array_equal(index, [0, 1, 0, 2])


def test_lines_break_between_terms() -> None:
    lines = wrapped(" ".join(["+\u00a01e-05\u00a0*\u00a0name"] * 30), "  ")
    assert len(lines) > 3 and all(len(line) <= 110 and line.endswith("+ 1e-05 * name") for line in lines)


def test_a_tree_without_inputs_is_refused() -> None:
    tree = otr.ObliqueTree([], [], np.zeros((0, 0)), [], np.zeros((1, 1, 0)), [[1.0]])
    for write in (otr.to_python, otr.to_c, otr.to_structured_text, otr.to_latex, otr.to_dot, otr.to_onnx, otr.to_json):
        with pytest.raises(ValueError, match="the tree has no inputs"):
            write(tree)


def test_leaves_are_numbered_from_the_top() -> None:
    tree = random_tree(np.random.default_rng(0), 9, 2, 1, 8)
    ordered = in_printed_order(tree)
    X = np.random.default_rng(1).normal(size=(200, 2))
    np.testing.assert_allclose(ordered.predict(X), tree.predict(X), rtol=1e-9, atol=1e-12)
    assert [leaf for what, leaf, _ in walk(ordered) if what == "leaf"] == list(range(9))
