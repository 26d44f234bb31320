import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.core.pruning import keep_leaves
from tests.core.strategies import Case, assert_same_answers, cases, worked_network
from tests.core.test_tree import naive_walk, random_tree


@given(cases())
def test_pruned_tree_equals_the_network_on_the_states_it_was_pruned_with(case: Case) -> None:
    net = case.network
    for tree in (otr.PatternTree(net), otr.map_network(net)):
        pruned = otr.prune_unreached(tree, case.states)
        np.testing.assert_allclose(pruned.forward(case.states), net.forward(case.states), rtol=1e-9, atol=1e-9)
        assert_same_answers(pruned.predict(case.states), net.predict(case.states), net, case)
        assert (np.bincount(pruned.apply(case.states), minlength=pruned.n_leaves) > 0).all()


def test_the_tree_of_a_network_too_wide_to_map_is_the_network_where_states_go() -> None:
    generator = np.random.default_rng(0)
    sizes = ((64, 3), (64, 64), (2, 64))
    biases = [generator.normal(size=n) for n, _ in sizes]
    network = otr.ReluNetwork([generator.normal(size=size) for size in sizes], biases)
    states = generator.normal(size=(40, 3))
    with pytest.raises(otr.TreeTooLargeError, match=r"otr\.tree\(network, states\)"):
        otr.map_network(network)
    tree = otr.tree(network, states)
    assert 1 < tree.n_leaves <= 40
    np.testing.assert_allclose(tree.predict(states), network.predict(states), rtol=1e-9)


@given(cases(), st.integers(1, 6))
def test_both_representations_prune_alike(case: Case, k: int) -> None:
    # States on a boundary may count for either side; the others must agree on everything.
    states = case.states if case.exact else case.states[:40]
    fresh = np.random.default_rng(k).normal(size=(50, case.network.n_inputs)) * 2
    full, patterns = otr.map_network(case.network), otr.PatternTree(case.network)
    for a, b in (
        (otr.prune_unreached(full, states[:10]), otr.prune_unreached(patterns, states[:10])),
        (otr.prune_to_k(full, states, k), otr.prune_to_k(patterns, states, k)),
    ):
        assert a.n_leaves == b.n_leaves
        np.testing.assert_array_equal(a.apply(fresh), b.apply(fresh))
        np.testing.assert_allclose(a.forward(fresh), b.forward(fresh), rtol=1e-9, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_kept_leaves_follow_the_tests_that_are_left(seed: int, n_leaves: int) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, n_leaves, 2, 1, 10)
    keep = rng.random(n_leaves) < 0.4
    keep[rng.integers(n_leaves)] = True
    pruned = keep_leaves(tree, keep)
    kept = np.flatnonzero(keep)
    below = {~leaf: [leaf] for leaf in range(tree.n_leaves)}
    for node in reversed(range(tree.n_nodes)):
        below[node] = below[int(tree.children_left[node])] + below[int(tree.children_right[node])]
    for x in rng.normal(size=(20, 2)):
        reference = 0 if tree.n_nodes else ~0
        while reference >= 0:
            left, right = int(tree.children_left[reference]), int(tree.children_right[reference])
            goes_left = tree.P[reference] @ x + tree.v[reference] <= 0
            if not keep[below[left]].any():
                goes_left = False
            elif not keep[below[right]].any():
                goes_left = True
            reference = left if goes_left else right
        assert kept[naive_walk(pruned, x)[0]] == ~reference


def test_worked_example_pruned_to_one_leaf_and_to_k() -> None:
    X = np.array([[0.5, -0.5]] * 3 + [[-2.0, 1.0]] * 2 + [[2.0, 2.0]])
    tree = otr.map_network(worked_network())
    two = otr.prune_to_k(tree, X, 2)
    sizes = [otr.prune_unreached(tree, X[:3]), otr.prune_unreached(tree, X), two, otr.prune_to_k(tree, X, 99)]
    assert [pruned.n_leaves for pruned in sizes] == [1, 3, 2, 3]
    np.testing.assert_allclose(two.predict(X[:5]), tree.predict(X[:5]))
    X = np.random.default_rng(0).normal(size=(100, 2))
    kept = otr.PatternTree(worked_network()).observe(X).keep(4)
    for prune in (lambda held: otr.prune_unreached(held, X[:3]), lambda held: otr.prune_to_k(held, X, 2)):
        np.testing.assert_array_equal(prune(kept).forward(X), prune(kept.to_tree()).forward(X))


def test_a_state_on_a_boundary_ends_in_its_own_leaf(monkeypatch: pytest.MonkeyPatch) -> None:
    net = otr.ReluNetwork([np.eye(2), [[1.0, 10.0]]], [np.zeros(2), [0.0]])
    tree = otr.map_network(net)
    X = np.array([[0.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    assert tree.apply(X).tolist() == [1, 2, 0]
    # As if rounding in the full tree sent the first state, which lies on the root's boundary, to the right. Leaves 0,
    # 2 and 3 would be kept, and the first state, sent left by the pruned tree, would end in leaf 0.
    monkeypatch.setattr(tree, "apply", lambda _: np.array([3, 2, 0]))
    np.testing.assert_array_equal(otr.prune_unreached(tree, X).predict(X), net.predict(X))


def test_bad_arguments_are_refused() -> None:
    tree = otr.map_network(worked_network())
    for subject in (tree, otr.PatternTree(worked_network())):
        with pytest.raises(ValueError, match="holds no states"):
            otr.prune_unreached(subject, np.empty((0, 2)))
        with pytest.raises(ValueError, match="or a NaN"):
            otr.prune_unreached(subject, np.array([[0.0, np.nan]]))
        with pytest.raises(ValueError, match="k is 0, expected at least 1"):
            otr.prune_to_k(subject, np.ones((1, 2)), 0)
    with pytest.raises(ValueError, match="one True"):
        keep_leaves(tree, np.zeros(8, dtype=bool))
