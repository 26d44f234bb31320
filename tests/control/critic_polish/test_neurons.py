"""Neurons that a network has only while it learns."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.control.critic_polish.neurons import can_widen, narrowed, widened

LOW, HIGH = [-1.0, -1.0], [1.0, 1.0]


def network(n_neurons, seed=0, **keywords):
    rng = np.random.default_rng(seed)
    weights = [rng.normal(size=(n_neurons, 3)), rng.normal(size=(2, n_neurons + 3 * bool(keywords.get("dense"))))]
    biases = [rng.normal(size=n_neurons), rng.normal(size=2)]
    return otr.ReluNetwork(weights, biases, head=otr.ClipBox(LOW, HIGH), **keywords)


def states(seed=1, n=300):
    return np.random.default_rng(seed).normal(size=(n, 3)) * [1.0, 10.0, 0.1] + [0.0, 5.0, 0.0]


@given(seed=st.integers(0, 99), dense=st.sampled_from([False, "input", True]), slope=st.sampled_from([0.0, 0.01]))
@settings(max_examples=40, deadline=None)
def test_new_neurons_hardly_change_a_network_and_are_the_first_to_go(seed, dense, slope):
    given_, X = network(4, seed, dense=dense, negative_slope=slope), states(seed)
    wide = widened(given_, 12, X, np.random.default_rng(seed))
    outputs, deviation = given_.forward(X), given_.forward(X).std(axis=0)
    assert wide.hidden_widths == (12,) and wide.head == given_.head and wide.dense == given_.dense
    assert 0 < np.abs((wide.forward(X) - outputs) / deviation).max() < 0.5
    share_on = wide.patterns(X)[:, 4:].mean(axis=0)
    assert ((share_on > 0) & (share_on < 1)).sum() >= 6  # tests pass through the states, of which few are outermost
    back = narrowed(wide, 4, X)
    assert back.hidden_widths == (4,)
    assert np.sqrt((((back.forward(X) - outputs) / deviation) ** 2).mean()) < 0.1
    assert widened(given_, 4, X, np.random.default_rng(0)) is narrowed(given_, 4, X) is given_


@pytest.mark.parametrize("dense", [False, "input"])
def test_a_neuron_that_the_others_can_stand_in_for_goes_without_a_trace(dense):
    given_, X = network(5, dense=dense), states()
    first, last = given_.weights[0].copy(), given_.weights[1]
    first[3], offsets = 2 * first[1], given_.biases[0].copy()
    offsets[3] = 2 * offsets[1]  # twice neuron 1
    twice = given_.replace(weights=[first, last], biases=[offsets, given_.biases[1]])
    kept = narrowed(twice, 4, X)
    np.testing.assert_allclose(kept.forward(X), twice.forward(X), atol=1e-5)
    dead = given_.replace(weights=[first, last], biases=[np.append(offsets[:4], -1e6), given_.biases[1]])
    np.testing.assert_allclose(narrowed(dead, 3, X).forward(X), dead.forward(X), atol=1e-5)


def test_the_neuron_that_goes_is_the_one_without_which_the_outputs_err_least():
    given_, X = network(4, dense="input"), states()
    z = X @ given_.weights[0].T + given_.biases[0]
    read = np.column_stack((np.maximum(z, 0), X, np.ones(len(X))))
    units, errors, outputs = given_.forward(X).std(axis=0), [], []
    for j in range(4):
        rest = np.delete(read, j, axis=1)
        fit = rest @ np.linalg.lstsq(rest, read[:, j], rcond=None)[0]
        outputs.append(given_.forward(X) + np.outer(fit - read[:, j], given_.weights[1][:, j]))
        errors.append((((outputs[-1] - given_.forward(X)) / units) ** 2).sum())
    np.testing.assert_allclose(narrowed(given_, 3, X).forward(X), outputs[int(np.argmin(errors))], atol=1e-5)


def test_which_policies_can_have_more_neurons():
    sparse = network(4).weights[0].copy()
    sparse[0, 0] = 0.0
    with_zero = network(4).replace(weights=[sparse, network(4).weights[1]])
    assert can_widen(network(4), 5, free=False) and not can_widen(network(4), 4, free=True)
    assert not can_widen(with_zero, 5, free=False) and can_widen(with_zero, 5, free=True)
    assert not can_widen(otr.map_network(network(4)), 5, free=True)
    deep = otr.ReluNetwork([np.ones((2, 3)), np.ones((2, 2)), np.ones((2, 2))], [np.ones(2)] * 3)
    linear = otr.ReluNetwork([np.ones((2, 3))], [np.ones(2)])
    assert not can_widen(deep, 5, free=True) and not can_widen(linear, 5, free=True)
