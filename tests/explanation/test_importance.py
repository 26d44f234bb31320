"""`importance` is the sums of its docstring, state by state."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from tests.core.strategies import make_network
from tests.core.test_tree import random_tree


@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_it_is_the_mean_over_states(seed: int, n_leaves: int) -> None:
    rng = np.random.default_rng(seed)
    tree, X = random_tree(rng, n_leaves, 3, 2, 5), rng.normal(size=(30, 3)) * [1.0, 5.0, 0.0]
    found, deviations = otr.importance(tree, X), X.std(axis=0)
    outputs = np.mean([np.abs(tree.M[tree.apply(x)]) * deviations for x in X], axis=0)
    np.testing.assert_allclose(found.outputs, outputs)
    decisions = [np.abs(tree.P[node]) * deviations for x in X for node in tree.decision_path(x).indices]
    expected = np.mean([sizes / sizes.sum() for sizes in decisions], axis=0) if decisions else np.zeros(3)
    np.testing.assert_allclose(found.decisions, expected, atol=1e-12)
    assert found.decisions.sum() == pytest.approx(1.0 if decisions else 0.0)


def test_a_pattern_tree_has_the_importance_of_the_paths_taken() -> None:
    rng = np.random.default_rng(0)
    net, X = make_network(rng, (20, 20), n_inputs=3, n_outputs=2, head="argmax"), rng.normal(size=(200, 3))
    found = otr.importance(otr.PatternTree(net), X)
    np.testing.assert_allclose(found.outputs, otr.importance(otr.tree(net, X), X).outputs)
    forms = np.abs(np.array([[net.forward(x + h) - net.forward(x - h) for h in 1e-6 * np.eye(3)] for x in X]) / 2e-6)
    np.testing.assert_allclose(found.outputs, forms.mean(axis=0).T * X.std(axis=0), rtol=1e-3)


def test_it_is_a_table() -> None:
    tree = otr.parse_program(
        "if speed <= 0: left else: right", ["angle", "speed"], labels=True, output_names=["left", "right"]
    )
    found = otr.importance(
        tree, [[1.0, -4.0], [-1.0, 4.0]], feature_names=["angle", "speed"], output_names=["left", "right"]
    )
    assert str(found).splitlines() == [
        "       left  right  decisions", "speed     0      0          1", "angle     0      0          0"
    ]  # fmt: skip
    expected = {"left": [0.0, 0.0], "right": [0.0, 0.0], "decisions": [0.0, 1.0]}
    pd.testing.assert_frame_equal(found.to_frame(), pd.DataFrame(expected, ["angle", "speed"]))
    assert found.to_dict()["decisions"] == [0.0, 1.0]


def test_states_are_needed() -> None:
    tree = otr.parse_program("if x <= 0: 1 else: 2", ["x"])
    for states in (np.zeros((0, 1)), [[np.nan]]):
        with pytest.raises(ValueError, match="importance needs at least one state"):
            otr.importance(tree, states)
