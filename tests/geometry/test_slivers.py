"""Minimal trees of networks whose neurons are nearly parallel, in every sliver between these that exact cells find."""

import numpy as np
import pytest

import otr
from otr.core.domain import as_domain
from otr.geometry.rational import nearest_state
from otr.proof.exact_cells import cells_of_leaf
from otr.proof.exact_rows import TreeAndNetwork

DOMAINS = (None, (-1.0, 1.0), (-10.0, 10.0), (-1000.0, 1000.0))


def nearly_parallel(rng: np.random.Generator) -> otr.ReluNetwork:
    """One to three layers; neurons that are others, turned round, doubled, or off by 1e-6 to 1e-16."""
    n_inputs = width_before = int(rng.integers(1, 4))
    weights, biases = [], []
    for layer in range(int(rng.integers(1, 4))):
        width = int(rng.integers(2, 5)) if layer == 0 else int(rng.integers(1, 4))
        W, b = rng.normal(size=(width, width_before)).round(1), rng.normal(size=width).round(1)
        W[~W.any(axis=1), 0] = 1.0
        for i in range(1, width):
            if rng.random() < 0.6:
                j, off = int(rng.integers(0, i)), 10.0 ** -rng.integers(6, 17)
                sign, size = rng.choice([1.0, 1.0, -1.0]), rng.choice([1.0, 1.0, 2.0])
                W[i] = sign * size * W[j] + off * rng.integers(-5, 6, width_before)
                b[i] = sign * b[j] + off * rng.integers(-3, 4) * rng.integers(0, 2)
        weights.append(W)
        biases.append(b)
        width_before = width
    weights.append(np.where(rng.random((1, width_before)) < 0.9, rng.normal(size=(1, width_before)).round(1), 0.0))
    biases.append(rng.normal(size=1).round(1))
    weights[-1][~weights[-1].any(axis=1), 0] = 1.0
    assert weights[0].shape[1] == n_inputs
    return otr.ReluNetwork(weights, biases)


def states_in_cells(network: otr.ReluNetwork, domain: tuple[float, float] | None) -> np.ndarray:
    """A state in every cell of the network, as near as float64 comes, and its neighbours."""
    d, o = network.n_inputs, network.n_outputs
    single = otr.ObliqueTree([], [], np.zeros((0, d)), [], np.zeros((1, o, d)), np.zeros((1, o)), head=network.head)
    cells = cells_of_leaf(TreeAndNetwork(single, network, as_domain(domain, d)), 0)
    states = [nearest_state(cell.point) for cell in cells]
    X = np.array([state for state in states if state is not None and np.abs(state).max() < 1e100])
    X = np.concatenate((X, np.nextafter(X, np.inf), np.nextafter(X, -np.inf)))
    return X if domain is None else np.clip(X, *domain)


def size_of_terms(network: otr.ReluNetwork, X: np.ndarray) -> np.ndarray:
    """The size of the terms whose sums a network's outputs at states X are: (n,)."""
    sizes = np.abs(X)
    for W, b in zip(network.weights, network.biases, strict=True):
        sizes = sizes @ np.abs(W).T + np.abs(b)
    return sizes.max(axis=1)


def worst_difference(seed: int) -> float:
    """The largest difference of minimal tree and network in any cell, in units of the size of the terms."""
    network, domain = nearly_parallel(np.random.default_rng(seed)), DOMAINS[seed % 4]
    tree, X = otr.minimal_tree(network, domain), states_in_cells(network, domain)
    gaps = np.abs(tree.forward(X) - network.forward(X)).max(axis=1)
    return float((gaps / size_of_terms(network, X)).max())


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
