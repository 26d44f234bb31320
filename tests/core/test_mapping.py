import tracemalloc

import numpy as np
import pytest
from hypothesis import given

import otr
from otr.core.smooth_network import SmoothNetwork
from tests.core.strategies import Case, assert_same_answers, cases, make_network, worked_network

X = np.array([0.5, -0.5])


def test_worked_example() -> None:
    tree = otr.map_network(worked_network())
    leaf = int(tree.apply(X))
    assert leaf == 0b001
    np.testing.assert_allclose(tree.M[leaf], [[1.2, -0.12]])
    np.testing.assert_allclose(tree.c[leaf], [2.84])
    np.testing.assert_allclose(tree.predict(X), [3.5])
    assert (tree.n_leaves, tree.n_nodes, tree.depth) == (8, 7, 3)


@given(cases())
def test_tree_equals_network_and_leaf_ids_are_activation_patterns(case: Case) -> None:
    net, tree = case.network, otr.map_network(case.network)
    tree.check()
    np.testing.assert_allclose(tree.forward(case.states), net.forward(case.states), rtol=1e-9, atol=1e-9)
    assert_same_answers(tree.predict(case.states), net.predict(case.states), net, case)
    bits = otr.PatternTree(net).paths(case.states)
    agree = tree.apply(case.states) == bits @ (2 ** np.arange(bits.shape[1])[::-1])
    assert agree.all() if case.exact else agree[:40].all()
    depth = net.n_hidden + {"sign": 1, "argmax": net.n_outputs - 1}.get(net.head.name, 0)
    assert (tree.depth, tree.n_leaves) == (depth, 2**depth)
    assert (tree.labels is not None) == (net.head.name in ("sign", "argmax"))


def test_zero_goes_left_and_a_tie_to_the_lowest_index() -> None:
    net = otr.ReluNetwork([[[1.0]]], [[0.0]], head=otr.Sign())
    assert otr.map_network(net).predict([[0.0], [1e-300], [-1.0]]).tolist() == [0, 1, 0]
    tree = otr.map_network(otr.ReluNetwork([[[1.0], [1.0], [2.0]]], [[0.0, 0.0, 0.0]], head=otr.Argmax()))
    assert (tree.depth, tree.predict([[0.0], [1.0], [-1.0]]).tolist()) == (2, [0, 2, 0])
    linear = otr.map_network(otr.ReluNetwork([[[1.0, 2.0]]], [[3.0]]))
    assert (linear.n_leaves, linear.n_nodes, linear.depth, linear.apply([1.0, 1.0])) == (1, 0, 0, 0)
    assert linear.predict([[1.0, 1.0]]).tolist() == [[6.0]]


def test_memory_is_at_most_twice_what_is_returned_and_a_tree_too_large_is_refused() -> None:
    net = make_network(np.random.default_rng(0), (16,), n_inputs=20)
    tracemalloc.start()
    tree = otr.map_network(net)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    arrays = (tree.P, tree.v, tree.M, tree.c, tree.children_left, tree.children_right)
    assert peak <= 2 * sum(array.nbytes for array in arrays)
    net = make_network(np.random.default_rng(0), (17,))
    message = r"17 hidden neurons .* 2\*\*17 leaves, the limit is 65536.*otr\.tree"
    with pytest.raises(otr.TreeTooLargeError, match=message):
        otr.map_network(net)
    assert otr.map_network(net, max_leaves=2**17).n_leaves == 2**17


def test_only_a_network_of_relu_units_has_a_tree() -> None:
    smooth = SmoothNetwork([[[1.0, 2.0]], [[1.0]]], [[0.0], [0.0]], activation="tanh")
    for what in (otr.map_network, otr.PatternTree, otr.minimal_tree):
        with pytest.raises(TypeError, match="SmoothNetwork, expected a ReluNetwork"):
            what(smooth)
    network = otr.ReluNetwork([[[1.0, 2.0]]], [[0.0]])
    for ask in (
        lambda: otr.prune_unreached(network, [[0.0, 0.0]]),
        lambda: otr.refit_tests(network, [[0.0, 0.0]]),
        lambda: otr.within(otr.PatternTree(network), (-1.0, 1.0), 0.1),
        lambda: otr.output_range(network, (-1.0, 1.0)),
    ):
        with pytest.raises(TypeError, match="expected an ObliqueTree"):
            ask()
    with pytest.raises(TypeError, match="integer"):
        otr.prune_to_k(otr.map_network(network), [[0.0, 0.0]], 1.5)
