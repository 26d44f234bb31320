import numpy as np
import pytest

import otr
from otr.programs.names import identifiers
from otr.programs.walk import in_printed_order, walk
from tests.core.test_tree import random_tree


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
