"""PID policies: the terms, the network that multiplies them with its gains, its tree and its text."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.control import constant_gains, pid_network, pid_observation, pid_observation_names
from otr.programs.picture.boxes import tree_boxes
from otr.programs.picture.formulas import Style
from otr.programs.picture.head_notes import head_note
from tests.control.pids import GAINS, NAMES, PROGRAM, gains_network, thesis_policy
from tests.core.strategies import make_network


def test_the_terms_by_hand() -> None:
    observation = pid_observation([0.5, 2.0], [[1.0, 0.0], [0.0, 3.0]], [1.0, -1.0])
    #                                    s          P = e - s   I = (e-h1)+(e-h2)  D = h2 - s
    np.testing.assert_array_equal(observation, [0.5, 2.0, 0.5, -3.0, 1.0, -5.0, -0.5, 1.0])
    assert pid_observation_names(["a", "b"]) == ["a", "b", "P_a", "P_b", "I_a", "I_b", "D_a", "D_b"]
    for state, history in (([1.0, 2.0], [[1.0, 2.0]]), ([1.0], [[1.0, 2.0]]), ([1.0], np.zeros((0, 1)))):
        with pytest.raises(ValueError, match="expected"):
            pid_observation(state, history, [1.0])


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 4),
    st.integers(1, 3),
    st.lists(st.integers(1, 3), max_size=2),
    st.sampled_from([0.0, 0.1]),
)
def test_network_and_tree_are_gains_times_terms(seed: int, d: int, a: int, widths: list[int], slope: float) -> None:
    rng = np.random.default_rng(seed)
    gains = make_network(rng, tuple(widths), n_inputs=d, n_outputs=a * 3 * d, negative_slope=slope)
    X = rng.normal(size=(20, 4 * d))
    theta = gains.forward(X[:, :d]).reshape(20, a, 3 * d)
    controls = np.array([[theta[i, j] @ X[i, d:] for j in range(a)] for i in range(20)])
    low, high = -rng.uniform(1, 2, a), rng.uniform(1, 2, a)
    actions = low + (np.tanh(controls) + 1) / 2 * (high - low)
    policy = pid_network(gains, low, high)
    assert policy.n_hidden == sum(widths) and policy.n_inputs == 4 * d
    np.testing.assert_allclose(policy.predict(X), actions, atol=1e-12)
    tree = otr.map_network(policy)
    np.testing.assert_allclose(tree.predict(X), actions, atol=1e-12)
    np.testing.assert_allclose(tree.predict(X[0]), actions[0], atol=1e-12)
    assert not tree.P[:, d:].any()  # its tests read the state alone
    pruned = otr.prune_unreached(tree, X)
    np.testing.assert_allclose(pruned.predict(X), actions, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 2))
def test_constant_gains_change_nothing_where_they_are_constant(seed: int, d: int, a: int) -> None:
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(2, d))
    gains = otr.ReluNetwork([W, np.zeros((a * 3 * d, 2))], [rng.normal(size=2), rng.normal(size=a * 3 * d)])
    policy = pid_network(gains, -np.ones(a), np.ones(a))
    X = rng.normal(size=(30, 4 * d))
    tree = otr.prune_unreached(otr.map_network(policy), X)
    constant = constant_gains(tree, X)
    assert constant.head == otr.TanhBox(-np.ones(a), np.ones(a)) and constant.n_leaves == tree.n_leaves
    np.testing.assert_allclose(constant.predict(X), policy.predict(X), atol=1e-12)


def test_constant_gains_are_the_means_over_each_leaf_s_states() -> None:
    policy = pid_network(otr.ReluNetwork([[[1.0]], [[2.0], [0.0], [-1.0]]], [[0.0], [5.0, 6.0, 7.0]]), [-1.0], [1.0])
    X = np.array([[-1.0, 0.1, 0.2, 0.3], [1.0, 0.1, 0.2, 0.3], [3.0, 0.1, 0.2, 0.3]])
    tree = constant_gains(otr.map_network(policy), X)
    np.testing.assert_allclose(tree.M[:, 0], [[0.0, 5.0, 6.0, 7.0], [0.0, 9.0, 6.0, 5.0]])
    np.testing.assert_allclose(tree.predict(X[2]), np.tanh([9.0 * 0.1 + 6.0 * 0.2 + 5.0 * 0.3]))
    for other, words in ((otr.map_network(policy), "no observation reaches leaf 1 of 2"), (tree, "expected a PidBox")):
        with pytest.raises(otr.InvalidTreeError, match=words):
            constant_gains(other, X[:1])


def test_networks_that_give_no_gains_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(otr.InvalidNetworkError, match="has 8 outputs, expected 9"):
        pid_network(make_network(rng, (1,), n_outputs=8), [-1.0], [1.0])
    with pytest.raises(otr.InvalidNetworkError, match="dense='input'"):
        pid_network(make_network(rng, (1,), n_outputs=9, dense="input"), [-1.0], [1.0])
    with pytest.raises(otr.InvalidNetworkError, match="give arrays"):
        otr.PidBox(-1.0, 1.0)
    with pytest.raises(otr.InvalidNetworkError, match=r"a multiple of 6 outputs.*the network has 9"):
        otr.ReluNetwork([np.ones((9, 3))], [np.ones(9)], head=otr.PidBox([-1.0], [1.0]))


def test_the_program_of_the_thesis() -> None:
    tree = otr.map_network(thesis_policy())
    assert otr.to_text(tree, feature_names=pid_observation_names(NAMES), precision=3) == PROGRAM


def test_other_programs() -> None:
    """Both leaves of constant gains are alike, so the program is without the test; several actions name their gains."""
    linear = otr.map_network(pid_network(gains_network({}), [-2.0], [2.0]))
    tree = constant_gains(linear, np.array([[9.0] * 12, [0.0] * 12]))
    np.testing.assert_allclose(tree.M[0, 0], [0.0] * 3 + GAINS)
    terms = " + ".join(
        f"{gain:.15g} {name}" for gain, name in zip(GAINS, pid_observation_names(NAMES)[3:], strict=True)
    )
    assert otr.to_text(tree, feature_names=pid_observation_names(NAMES)) == f"return 2 tanh({terms})\n"
    two = pid_network(otr.ReluNetwork([np.zeros((6, 1))], [np.arange(1.0, 7.0)]), [-1.0, 0.0], [1.0, 4.0])
    text = otr.to_text(otr.map_network(two), feature_names=pid_observation_names(["x"]), output_names=["left", "right"])
    assert "\ntheta_D_left = [3]\ntheta_P_right = [4]\n" in text
    assert text.endswith("right = 2 + 2 tanh(theta_P_right . P + theta_I_right . I + theta_D_right . D)\n")


def test_the_picture_shows_the_gains() -> None:
    tree = otr.map_network(thesis_policy())
    style = Style(pid_observation_names(NAMES), ["torque"], precision=3, max_terms=4)
    test, left, right = tree_boxes(tree, style, None, None)
    assert test.kind == "test"
    assert left.rows[:2] == (("3.15", "P_x"), ("+3.24", "P_y")) and left.rows[8] == ("+0.13", "D_w")
    assert right.rows[3:6] == (("θ(s)", "I_x"), ("+0.52", "I_y"), ("θ(s)", "I_w"))
    assert head_note(tree) == "gains times terms go through tanh, scaled to [−2, 2]"
    otr.draw_tree(tree, feature_names=pid_observation_names(NAMES), output_names=["torque"])
