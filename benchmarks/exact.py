"""Exact trees: seconds for the minimal tree of a layer, beside affinitree 0.23 on the same networks.

One hidden layer of n neurons, d inputs, one output, weights and biases drawn from the standard normal distribution: in
general position, so that the tree on all of R^d has sum_{i <= d} C(n, i) leaves. Both are given the whole of R^d, and
CPU seconds of one process are counted, affinitree's building of its input apart. Beyond a million leaves neither is
asked. The certificate of the same tree, and its verification, follow for the sizes that anyone would store.

Targets: 32 neurons and 3 inputs in under 4 s; as many leaves as affinitree; no slower, and 3 times faster for 32 x 3
and 16 x 8. With 6 neurons neither takes more than a millisecond, ours for calls of numpy; it misses by a part of one.
"""

import contextlib
import io
import time
from math import comb

import affinitree
import numpy as np
import torch
from torch import nn

import otr
from benchmarks.measure import Entry

torch.set_num_threads(1)

NEURONS, INPUTS = (6, 8, 16, 32), (2, 3, 8, 17)
MAX_LEAVES = 2**20
ROUNDS, ROUNDS_OF_SMALL = 3, 20


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick measures the small sizes only, once."""
    entries = []
    for n in NEURONS:
        for d in INPUTS:
            n_leaves = sum(comb(n, i) for i in range(min(n, d) + 1))
            if n_leaves <= (300 if quick else MAX_LEAVES):
                entries += _minimal(n, d, 1 if quick else ROUNDS_OF_SMALL if n_leaves < 300 else ROUNDS)
            elif not quick:
                entries.append(Entry(f"{n} neurons, {d} inputs: not asked; leaves", n_leaves, "leaves", clock=None))
    for n, d in ((6, 2), (8, 3)) if quick else ((6, 8), (8, 3), (16, 3), (32, 3)):
        entries += _certificate(n, d)
    return entries


def random_network(n: int, d: int) -> otr.ReluNetwork:
    """Return a network of one hidden layer in general position."""
    rng = np.random.default_rng(1000 * n + d)
    return otr.ReluNetwork([rng.normal(size=(n, d)), rng.normal(size=(1, n))], [rng.normal(size=n), rng.normal(size=1)])


def affinitree_seconds(network: otr.ReluNetwork) -> tuple[float, int]:
    """Return the CPU seconds that affinitree takes for a network's tree, and the number of its leaves."""
    (W, U), (b, c) = network.weights, network.biases
    module = nn.Sequential(nn.Linear(*W.T.shape), nn.ReLU(), nn.Linear(*U.T.shape)).double()
    with torch.no_grad():
        for layer, weight, bias in ((module[0], W, b), (module[2], U, c)):
            layer.weight.copy_(torch.tensor(weight))
            layer.bias.copy_(torch.tensor(bias))
    architecture = affinitree.extract_pytorch_architecture(network.n_inputs, module)
    with contextlib.redirect_stdout(io.StringIO()):
        began = time.process_time()
        tree = affinitree.builder.from_layers(architecture)
        seconds = time.process_time() - began
    return seconds, tree.num_terminals()


def _minimal(n: int, d: int, rounds: int) -> list[Entry]:
    network = random_network(n, d)
    ours, theirs = [], []
    for _ in range(rounds):
        began = time.process_time()
        tree = otr.minimal_tree(network)
        ours.append(time.process_time() - began)
        seconds, n_leaves = affinitree_seconds(network)
        theirs.append(seconds)
    what = f"{n} neurons, {d} inputs"
    target = "ratio <= 0.333" if (n, d) in ((32, 3), (16, 8)) else "ratio <= 1"
    seconds = Entry(f"{what}: minimal tree", min(ours), "s", "affinitree 0.23", min(theirs), target)
    leaves = Entry(f"{what}: leaves", tree.n_leaves, "leaves", "affinitree 0.23", n_leaves, "ratio <= 1", clock=None)
    print(f"exact: {what} done", flush=True)
    if (n, d) == (32, 3):
        return [seconds, Entry(f"{what}: minimal tree, at most", min(ours), "s", target="value <= 4"), leaves]
    return [seconds, leaves]


def _certificate(n: int, d: int) -> list[Entry]:
    """Return the seconds for a certificate on the box [-1, 1]^d and for its verification, in float64 and exactly."""
    network, box = random_network(n, d), (-1.0, 1.0)
    tree = otr.minimal_tree(network, box)
    what = f"{n} neurons, {d} inputs, [-1, 1]: {tree.n_leaves:,} leaves"
    entries = []
    for exact in (False, True):
        began = time.process_time()
        certificate = otr.certify(tree, network, box, exact=exact)
        certified = time.process_time()
        otr.verify(certificate, tree, network)
        verified = time.process_time()
        kind = "exact certificate" if exact else "certificate"
        entries.append(Entry(f"{what}: {kind}", certified - began, "s"))
        entries.append(Entry(f"{what}: {kind} verified", verified - certified, "s"))
    print(f"exact: certificate of {n} x {d} done", flush=True)
    return entries
