"""Boxes in which some inputs are constants: as with the constants in the place of the inputs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.proof.properties import check_verdict
from tests.core.strategies import Case, cases


def substituted(network: otr.ReluNetwork, at: int, value: float) -> otr.ReluNetwork:
    """Return the network without an input, which has a value: of whole numbers, so that nothing is rounded."""
    kept, weights, biases = np.delete(np.arange(network.n_inputs), at), [], []
    for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        n_others = W.shape[1] - (network.n_inputs if network.dense or layer == 0 else 0)
        if n_others == W.shape[1]:
            weights.append(W)
            biases.append(b)
            continue
        weights.append(W[:, [*range(n_others), *(n_others + kept)]])
        biases.append(b + value * W[:, n_others + at])
    return network.replace(weights=weights, biases=biases)


@settings(max_examples=40)
@given(cases(heads=("identity", "argmax", "tanh_box"), max_layers=2), st.integers(-3, 30), st.data())
def test_a_constant_is_substituted(case: Case, value: int, data: st.DataObject) -> None:
    network = case.network
    if not case.exact or network.n_inputs < 2:
        return
    at = data.draw(st.integers(0, network.n_inputs - 1))
    low, high = np.full(network.n_inputs, -2.0), np.full(network.n_inputs, 2.0)
    low[at] = high[at] = value
    tree = otr.minimal_tree(network, (low, high))
    fewer = substituted(network, at, value)
    assert tree.n_leaves == otr.minimal_tree(fewer, (-2.0, 2.0)).n_leaves
    for any_tree in (tree, otr.map_network(network)):
        certificate = otr.certify(any_tree, network, (low, high))
        assert otr.verify(certificate, any_tree, network) == certificate.max_error < 1e-9
    if tree.labels is not None:
        assert otr.reachable_labels(tree, (low, high)).tolist() == np.unique(tree.labels).tolist()
        return
    found, expected = otr.output_range(tree, (low, high)), otr.output_range(otr.minimal_tree(fewer, (-2, 2)), (-2, 2))
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high], atol=1e-9)
    assert (found.low_states[:, at] == value).all()
    condition = otr.Condition(np.eye(network.n_inputs)[at], np.zeros(network.n_outputs), value)
    verdict = otr.find_violation(tree, condition, (low, high))
    check_verdict(verdict, tree, condition, (low, high))
    assert verdict.holds and verdict.value == value
    assert otr.find_difference(tree, otr.map_network(network), (low, high), max_difference=1e-9).holds


def test_a_certificate_of_a_point_and_of_an_edge_is_saved_and_verified(tmp_path) -> None:
    network = otr.ReluNetwork([[[1.0, 0.1], [1.0, -0.1]], [[1.0, 2.0]]], [[0.0, 0.5], [0.25]])
    for low, high, n_leaves in (([0.5, 30.0], [0.5, 30.0], 1), ([-5.0, 30.0], [5.0, 30.0], 3)):
        tree = otr.minimal_tree(network, (low, high))
        assert tree.n_leaves == n_leaves
        certificate = otr.certify(tree, network, (low, high))
        again = otr.load_certificate(certificate.save(tmp_path / "certificate.json"))
        assert again == certificate and again.domain.high[1] == 30
        assert otr.verify(again, tree, network) == certificate.max_error < 1e-14
        found = otr.output_range(tree, (low, high))
        X = np.linspace(low, high, 50)
        assert found.high[0] == pytest.approx(network.predict(X).max())
        wrong = tree.replace(c=tree.c + 1e-3)
        with pytest.raises(otr.CertificateError, match="not the same function"):
            otr.certify(wrong, network, (low, high))
