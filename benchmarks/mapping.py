"""Mapping: time and peak memory of `map_network` against the number of neurons, and of counting patterns at depth 32.

Measured: networks of 20 inputs and 4 outputs, n hidden neurons in one layer or in two, mapped to trees of 2**n leaves.
Peers: for time, the recursion that copies the network's weights at every node; for memory, the arrays that the tree
consists of. Then a `PatternTree` of 32 neurons and 27 inputs observes states.

Targets: n = 16 in at most 2 s with a peak of at most 2 times the arrays returned; 1,000,000 states observed in at most
10 s with a peak of at most 1,000 MB in addition to the states.
"""

import itertools
from collections.abc import Sequence

import numpy as np

import otr
from benchmarks.measure import Entry, alternate, peak_bytes

N_INPUTS, N_OUTPUTS = 20, 4
MEGABYTE = 1e6


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick has three sizes and a tenth of the states."""
    generator = np.random.default_rng(0)
    entries = []
    for n in (4, 8, 16) if quick else (4, 8, 10, 12, 14, 16):
        for widths in ([n], [n // 2, n // 2]):
            network = random_network([N_INPUTS, *widths, N_OUTPUTS], generator)
            entries += _mapping(network, rounds=2 if quick else 5)
        print(f"mapping: n = {n} done", flush=True)
    return entries + _observing(generator, n_states=100_000 if quick else 1_000_000, rounds=1 if quick else 3)


def random_network(
    widths: Sequence[int], generator: np.random.Generator, head: otr.Head | None = None
) -> otr.ReluNetwork:
    """Return a network of the given widths, inputs and outputs included, with He-scaled Gaussian weights."""
    weights = [generator.normal(0.0, (2 / d) ** 0.5, (o, d)) for d, o in itertools.pairwise(widths)]
    biases = [generator.normal(0.0, 0.5, o) for o in widths[1:]]
    return otr.ReluNetwork(weights, biases, head=head)


def copying_tree(weights: list[np.ndarray], biases: list[np.ndarray], neuron: int = 0) -> tuple:
    """Return the tree by plain recursion: each child gets copies of all weights, with one more neuron decided.

    A neuron that is off has its row of the weights zeroed; when a layer is decided, it is multiplied into the next.
    """
    if len(weights) == 1:
        return weights[0], biases[0]
    if neuron == len(biases[0]):
        merged = [weights[1] @ weights[0], *(W.copy() for W in weights[2:])]
        return copying_tree(merged, [weights[1] @ biases[0] + biases[1], *(b.copy() for b in biases[2:])])
    off_weights, off_biases = [W.copy() for W in weights], [b.copy() for b in biases]
    off_weights[0][neuron], off_biases[0][neuron] = 0.0, 0.0
    on_weights, on_biases = [W.copy() for W in weights], [b.copy() for b in biases]
    test = weights[0][neuron].copy(), biases[0][neuron]
    return test, copying_tree(off_weights, off_biases, neuron + 1), copying_tree(on_weights, on_biases, neuron + 1)


def _mapping(network: otr.ReluNetwork, rounds: int) -> list[Entry]:
    n = network.n_hidden
    layers = "one layer" if len(network.hidden_widths) == 1 else "two layers"
    tree = otr.map_network(network)
    arrays = (tree.children_left, tree.children_right, tree.P, tree.v, tree.M, tree.c)
    returned = sum(array.nbytes for array in arrays)
    del tree, arrays
    seconds, peer_s = alternate(
        lambda: otr.map_network(network),
        lambda: copying_tree(list(network.weights), list(network.biases)),
        rounds=rounds,
    )
    peak = peak_bytes(lambda: otr.map_network(network))
    peer = "recursion with copied weights"
    name = f"map_network, n={n}, {layers}"
    is_largest = n == 16
    time_entry = Entry(f"{name}: time", seconds, "s", peer, peer_s, "value <= 2" if is_largest else None)
    memory_entry = Entry(
        f"{name}: peak memory",
        peak / MEGABYTE,
        "MB",
        "arrays returned",
        returned / MEGABYTE,
        target="ratio <= 2" if is_largest else None,
        clock=None,
    )
    return [time_entry, memory_entry]


def _observing(generator: np.random.Generator, n_states: int, rounds: int) -> list[Entry]:
    network = random_network([27, 32, 8], generator)
    X = generator.normal(size=(n_states, 27))
    name = f"PatternTree.observe, n=32, {n_states:,} states"
    print(f"mapping: {name}", flush=True)
    (seconds,) = alternate(lambda: otr.PatternTree(network).observe(X), rounds=rounds)
    peak = peak_bytes(lambda: otr.PatternTree(network).observe(X))
    return [
        Entry(f"{name}: time", seconds, "s", target="value <= 10"),
        Entry(f"{name}: peak memory beside the states", peak / MEGABYTE, "MB", target="value <= 1000", clock=None),
    ]
