import numpy as np
import pytest

import otr
from otr.learners import AugTreeClassifier, AugTreeRegressor, CARTClassifier
from tests.core.strategies import make_network
from tests.learners.problems import rotated_xor, turned


def xor_oracle():
    """Its hidden units are the two oblique directions of `rotated_xor`."""
    return otr.ReluNetwork([turned(np.eye(2), np.pi / 4).T, np.zeros((1, 2))], [np.zeros(2), np.zeros(1)])


@pytest.mark.parametrize("include_inputs", [True, False])
def test_tests_are_rows_of_the_first_layer(include_inputs):
    X, y = rotated_xor(400)
    fresh, truth = rotated_xor(2000, seed=1)
    network = xor_oracle()
    model = AugTreeClassifier(network=network, include_inputs=include_inputs, max_depth=3, random_state=0).fit(X, y)
    assert model.network_ is network
    rows = [*network.weights[0].tolist(), *(np.eye(2).tolist() if include_inputs else [])]
    assert all(test in rows for test in model.tree_.P.tolist())
    if not include_inputs:  # with them, the greedy first test of an XOR is anyone's guess
        assert model.score(fresh, truth) == 1.0
    assert CARTClassifier(max_depth=3, random_state=0).fit(X, y).score(fresh, truth) < 0.92


def test_relu_units_as_features_and_linear_leaves_give_the_network_back():
    rng = np.random.default_rng(0)
    network = make_network(rng, (2,), n_inputs=3, n_outputs=2)
    X = rng.normal(size=(3000, 3))
    y = network.forward(X)
    linear = AugTreeRegressor(network=network, leaves="linear", max_depth=2, random_state=0).fit(X, y)
    constant = AugTreeRegressor(network=network, max_depth=2, random_state=0).fit(X, y)
    assert linear.tree_.n_leaves == 4
    assert linear.score(X, y) > 0.999
    assert constant.score(X, y) < 0.9


def test_it_trains_its_own_network():
    X, y = rotated_xor(600)
    model = AugTreeClassifier(hidden_layer_sizes=(12, 4), mlp_max_iter=300, max_depth=5, random_state=0).fit(X, y)
    assert model.network_.hidden_widths == (12, 4)
    assert model.score(X, y) > 0.95
    large = AugTreeClassifier(max_depth=5, random_state=0).fit(1e6 * X, y)  # the network's inputs are scaled
    assert large.score(1e6 * X, y) == AugTreeClassifier(max_depth=5, random_state=0).fit(X, y).score(X, y)


def test_errors():
    X, y = rotated_xor(50)
    linear = otr.ReluNetwork([np.ones((1, 2))], [np.zeros(1)])
    with pytest.raises(ValueError, match="has 0 hidden neurons"):
        AugTreeClassifier(network=linear).fit(X, y)
    with pytest.raises(ValueError, match="reads 2 inputs and has 2 hidden neurons; expected 3 inputs"):
        AugTreeRegressor(network=xor_oracle()).fit(np.zeros((50, 3)), y)
