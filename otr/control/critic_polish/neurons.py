"""A network of one hidden layer with more neurons while it learns, of which the least useful go one by one."""

import numpy as np

from otr.control.search.state_moments import scale_of
from otr.core.arrays import FloatArray
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree

FIRST_SHARE = 0.01  # of the outputs' deviations that a new neuron begins with
RIDGE = 1e-9  # of a neuron's mean square, under which it counts as a function of the others


def can_widen(policy: ObliqueTree | ReluNetwork, n_neurons: int, *, free: bool) -> bool:
    """Return whether a policy can have so many neurons for a while: a network of one layer of fewer, which all move."""
    if not isinstance(policy, ReluNetwork) or len(policy.hidden_widths) != 1 or policy.n_hidden >= n_neurons:
        return False
    return free or all(each.all() for each in (*policy.weights, *policy.biases))


def widened(network: ReluNetwork, n_neurons: int, states: FloatArray, rng: np.random.Generator) -> ReluNetwork:
    """Return nearly the same network with neurons added, up to `n_neurons`, whose tests pass through states (n, d)."""
    (first, last), (offsets, last_offsets) = network.weights, network.biases
    n_new = n_neurons - len(first)
    if n_new <= 0:
        return network
    directions = rng.standard_normal((n_new, network.n_inputs))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True) * scale_of(states.mean(axis=0), states.std(axis=0))
    through = states[rng.integers(len(states), size=n_new)]
    sizes = FIRST_SHARE * network.forward(states).std(axis=0)
    weights = sizes[:, None] * rng.standard_normal((network.n_outputs, n_new))
    return network.replace(
        weights=[np.vstack((first, directions)), np.insert(last, [len(first)] * n_new, weights, axis=1)],
        biases=[np.append(offsets, -(directions * through).sum(axis=1)), last_offsets],
    )


def narrowed(network: ReluNetwork, n_neurons: int, states: FloatArray) -> ReluNetwork:
    """Return a network without the neurons that add least over states (n, d) to what the others can do.

    One after the other, what reads a neuron reads instead its least-squares fit by all that it reads besides (as He,
    Zhang & Sun 2017 prune channels). The one goes whose fit errs least in the outputs, in units of their deviations.
    """
    units = scale_of(np.zeros(network.n_outputs), network.forward(states).std(axis=0))
    while len(network.weights[0]) > n_neurons:
        (first, last), (offsets, last_offsets) = network.weights, network.biases
        n, ones = len(first), np.ones((len(states), 1))
        z = states @ first.T + offsets
        activations = np.maximum(z, network.negative_slope * z)
        read = np.hstack((activations, states, ones) if network.dense else (activations, ones))
        squares = read.T @ read / len(states)
        squares[np.diag_indices_from(squares)] += RIDGE * (np.diag(squares).mean() + np.diag(squares))
        precisions = np.linalg.inv(squares)
        errors = ((last[:, :n] / units[:, None]) ** 2).sum(axis=0) / np.diag(precisions)[:n]
        j = int(errors.argmin())
        fit = np.delete(-precisions[j] / precisions[j, j], j)
        whole = np.delete(np.column_stack((last, last_offsets)), j, axis=1) + last[:, j : j + 1] * fit
        network = network.replace(
            weights=[np.delete(first, j, axis=0), whole[:, :-1]], biases=[np.delete(offsets, j), whole[:, -1]]
        )
    return network
