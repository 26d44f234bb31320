import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from tests.core.strategies import Case, cases, worked_network

X = np.array([0.5, -0.5])


def test_worked_example() -> None:
    net = worked_network()
    np.testing.assert_allclose(net.weights[0] @ X + net.biases[0], [-1.35, -0.30, 1.75])
    assert net.patterns(X).tolist() == [False, False, True]
    np.testing.assert_allclose(net.forward(X), [3.5])
    assert (net.n_inputs, net.n_outputs, net.n_hidden, net.hidden_widths) == (2, 1, 3, (3,))
    W, states = np.ones((1, 2)), np.ones((5, 2))
    net = otr.ReluNetwork([W], [[0.0]])
    W[0, 0] = 5.0  # the network has its arrays to itself
    assert net.predict(states).tolist() == [[2.0]] * 5 and (states == 1).all()
    with pytest.raises(ValueError, match="read-only"):
        net.weights[0][0, 0] = 2.0


@given(cases())
def test_forward_follows_the_definition(case: Case) -> None:
    net = case.network
    for x, y in zip(case.states[:5], net.forward(case.states), strict=False):
        activations: list[np.ndarray] = []
        for layer, (W, b) in enumerate(zip(net.weights, net.biases, strict=True)):
            last = activations[-1:]
            reads = {False: last, "input": [*last, x], "all": [*activations, x]}[net.dense] if layer else [x]
            z = W @ np.concatenate(reads) + b
            activations.append(np.where(z > 0, z, net.negative_slope * z))
        np.testing.assert_allclose(y, z, rtol=1e-9, atol=1e-9)
    x = case.states[0]
    np.testing.assert_allclose(net.predict(x), net.predict(case.states)[0], rtol=1e-9, atol=1e-9)
    assert net.forward(x).shape == (net.n_outputs,) and net.patterns(x).shape == (net.n_hidden,)


@given(cases(), st.integers(0, 1000))
def test_fold_input_normalisation(case: Case, seed: int) -> None:
    rng = np.random.default_rng(seed)
    d = case.network.n_inputs
    mean, scale = rng.normal(size=d), rng.uniform(0.5, 2, d)
    folded = case.network.fold_input_normalisation(mean, scale)
    expected = case.network.forward((case.states - mean) / scale)
    np.testing.assert_allclose(folded.forward(case.states), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("weights", "biases", "options", "message"),
    [
        ([[[1.0, np.nan]]], [[0.0]], {}, "layer 0 of 1: a weight or bias is not finite"),
        ([[[1.0]], [[1.0]]], [[0.0], [np.inf]], {}, "layer 1 of 2: a weight or bias is not finite"),
        ([[[1.0]], [[1.0, 2.0]]], [[0.0], [0.0]], {}, "layer 1 of 2: weight has 2 columns, the layer reads 1"),
        ([[[1.0]], [[1.0]]], [[0.0], [0.0]], {"dense": "input"}, "1 columns, the layer reads 2"),
        ([[[1.0]]], [[0.0, 1.0]], {}, r"shape \(1, 1\) and bias \(2,\)"),
        ([[1.0]], [[0.0]], {}, r"expected \(n_out, n_in\)"),
        ([[[1.0]]], [], {}, "1 weight matrices and 0 bias vectors"),
        ([], [], {}, "at least one"),
        ([[[1.0]]], [[0.0]], {"negative_slope": 1.0}, "0 <= negative_slope < 1"),
        ([[[1.0]]], [[0.0]], {"negative_slope": float("nan")}, "0 <= negative_slope < 1"),
        ([[[1.0]]], [[0.0]], {"dense": "some"}, "dense is 'some'"),
        ([[[1.0, 2.0], [3.0]]], [[0.0, 0.0]], {}, "the weight of layer 0 is no array of real numbers"),
        ([[[1.0]]], [["a"]], {}, "the bias of layer 0 is no array of real numbers"),
        ([[[1.0j]]], [[0.0]], {}, "the weight of layer 0 is no array of real numbers: its type is complex128"),
        ([[[1.0]]], [[0.0]], {"head": "tanh"}, "head is 'tanh'"),
        ([[[1.0]]], [[0.0]], {"head": otr.Sign}, "expected an instance"),
    ],
)
def test_bad_networks_are_refused(weights: list, biases: list, options: dict, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.ReluNetwork(weights, biases, **options)


def test_bad_numbers_for_a_network_are_refused() -> None:
    for mean, scale in ((0.0, 0.0), (np.nan, 1.0), ([0.0], [1.0]), (0.0, np.inf)):
        with pytest.raises(otr.InvalidNetworkError, match="scale"):
            worked_network().fold_input_normalisation(mean, scale)
    for call in (worked_network().forward, otr.map_network(worked_network()).predict):
        with pytest.raises(ValueError, match=r"shape \(4, 3\), expected \(n, 2\)"):
            call(np.ones((4, 3)))
    for side in (([1e200], [np.inf]), ([-np.inf], [-1e200]), ([0.0], [1e200])):
        with pytest.raises(ValueError, match=r"wider than 1e\+100; leave such a side open"):
            otr.Domain(*side)


def test_a_domain_goes_with_the_network() -> None:
    domain = otr.Domain([0.0, -1.0], [2.0, np.inf])
    net = worked_network()
    assert net.domain is None and net.fold_input_normalisation(1.0, 2.0).domain is None
    within = otr.ReluNetwork(net.weights, net.biases, domain=domain)
    assert within.domain == domain
    assert within.fold_input_normalisation([10.0, 20.0], [3.0, 2.0]).domain == otr.Domain([10.0, 18.0], [16.0, np.inf])
    assert within.fold_input_normalisation(0.0, [-1.0, -1.0]).domain == otr.Domain([-2.0, -np.inf], [0.0, 1.0])
    dead = [[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0]]]
    trimmed = otr.ReluNetwork(dead, [[0.0, 0.0], [0.0]], domain=domain).without_dead_neurons()
    assert (trimmed.n_hidden, trimmed.domain) == (1, domain)
    with pytest.raises(ValueError, match="the domain has 1 inputs, expected 2"):
        otr.ReluNetwork(net.weights, net.biases, domain=([0.0], [1.0]))
    domain = otr.Domain([0.0, -np.inf], [2.0, 5.0])
    states = [[0, 5], [2, -1e300], [2.0000001, 0], [1, 5.1], [-0.1, 0], [np.nan, 0], [1, -np.inf]]
    assert domain.contains(states).tolist() == [True, True, False, False, False, False, True]
    assert domain.contains([1.0, 1.0]).tolist() == [True]
    with pytest.raises(ValueError, match=r"shape \(3,\), expected \(n, 2\)"):
        domain.contains([1.0, 1.0, 1.0])
