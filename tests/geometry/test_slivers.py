"""Minimal trees of networks whose neurons are nearly parallel, in the slivers between these."""

import numpy as np
import pytest

import otr
from tests.geometry.slivers import worst_difference


def test_a_sliver_in_which_another_neuron_parts_the_states() -> None:
    """Between x > 0 and x + 3e-9 y > 0 the tree once answered -3."""
    weights = [[[1, 0], [1, 3e-9], [0, 1]], [[1, 1, 1]], [[1]]]
    network = otr.ReluNetwork(weights, [[0, 0, 20], [-25], [0]])
    tree = otr.minimal_tree(network, (-10, 10))
    assert tree.predict([-3e-9, 2]).tolist() == network.predict([-3e-9, 2]).tolist() == [0.0]
    certificate = otr.certify(tree, network, (-10, 10))
    assert otr.verify(certificate, tree, network) < 1e-9


def test_what_highs_could_not_solve() -> None:
    weights = [
        [[-0.2, -0.3], [-0.2000000001, -0.2999999995]], [[1.4, 0.8], [-1, 0.9], [-1.5, 0.3]], [[1, 0.3, 0.5]],
    ]  # fmt: skip
    network = otr.ReluNetwork(weights, [[-0.1, -0.1], [-1.9, 1.6, 0.1], [0]])
    tree = otr.minimal_tree(network)
    X = np.random.default_rng(0).normal(size=(2000, 2)) * np.logspace(-3, 9, 2000)[:, None]
    np.testing.assert_allclose(tree.forward(X), network.forward(X), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", [1e-300, 1e-180, 1e-170, 1e160, 1e200, 1e300])
def test_weights_of_any_size_are_tests(size: float) -> None:
    network = otr.ReluNetwork([[[size, 0.0], [size, size]], [[1.0, -1.0]]], [[0.0, 0.0], [0.0]])
    for domain in (None, (-2.0, 2.0)):
        tree = otr.minimal_tree(network, domain)
        assert tree.n_leaves == 4
        X = np.random.default_rng(0).uniform(-2, 2, (500, 2))
        np.testing.assert_allclose(tree.forward(X) / size, network.forward(X) / size, atol=1e-12)
        assert otr.verify(otr.certify(tree, network, domain), tree, network) <= 1e-9 * size


@pytest.mark.parametrize("n", [100, pytest.param(10_000, marks=pytest.mark.slow)])
def test_nearly_parallel_neurons(n: int) -> None:
    assert max(worst_difference(seed) for seed in range(n)) < 1e-9
