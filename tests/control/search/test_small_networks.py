"""The networks that are searched: what the vector means, and that they begin by doing nothing."""

import numpy as np
import pytest

import otr
from otr.control.search.small_networks import NetworkShape

BOX = (np.array([-2.0, 0.0]), np.array([2.0, 1.0]))


@pytest.mark.parametrize(
    ("widths", "dense", "n_numbers"),
    [
        ((), False, 2 * 4),
        ((6,), False, 6 * 4 + 2 * 7),
        ((6,), "input", 6 * 4 + 2 * (7 + 3)),
        ((4, 5), "input", 4 * 4 + 5 * (5 + 3) + 2 * (6 + 3)),
    ],
)
def test_numbers_and_first_network(widths, dense, n_numbers):
    shape = NetworkShape(3, widths, 2, BOX, dense)
    assert shape.n_numbers == n_numbers
    first = shape.network(shape.initial(np.random.default_rng(0)), np.zeros(3), np.ones(3))
    assert first.hidden_widths == widths
    states = np.random.default_rng(1).normal(size=(50, 3))
    np.testing.assert_array_equal(first.predict(states), np.tile([0.0, 0.5], (50, 1)))  # the middle of the box
    if widths:
        assert first.patterns(states).any()


def test_reads_normalised_states_and_acts_in_half_widths_of_the_box():
    shape = NetworkShape(3, (2,), 2, BOX, "input", negative_slope=0.1)
    vector = np.random.default_rng(0).normal(size=shape.n_numbers)
    mean, scale = np.array([1.0, -2.0, 0.5]), np.array([2.0, 0.5, 3.0])
    x = np.random.default_rng(1).normal(size=(20, 3))
    normal = (x - mean) / scale
    hidden, outputs = vector[:8].reshape(2, 4), vector[8:].reshape(2, 6)
    z = normal @ hidden[:, :3].T + hidden[:, 3]
    a = np.where(z > 0, z, 0.1 * z)
    u = a @ outputs[:, :2].T + normal @ outputs[:, 2:5].T + outputs[:, 5]
    expected = np.clip(np.array([0.0, 0.5]) + u * np.array([2.0, 0.5]), *BOX)
    network = shape.network(vector, mean, scale)
    np.testing.assert_allclose(network.predict(x), expected, atol=1e-12)
    np.testing.assert_allclose(otr.map_network(network).predict(x), expected, atol=1e-12)
    labels = NetworkShape(4, (), 3, None).network(np.arange(15.0), np.zeros(4), np.ones(4))
    assert labels.predict(np.ones((1, 4))).tolist() == [2]
