"""Exact trees: seconds for minimal trees, compared with affinitree 0.23 on the same networks.

One hidden layer of n neurons, d inputs, one output, weights and biases normally distributed: in general position, so
that the tree on all of R^d has sum_{i <= d} C(n, i) leaves. Both are given the whole of R^d, and CPU seconds of one
process are counted, affinitree's building of its input apart. Beyond a million leaves neither is asked. Networks of 180
to 784 inputs follow, in one and two layers, with the peak memory less that of the imports; then such networks on a box,
with certificate and verification, which affinitree does not have. The certificate of a tree on a box, and its
verification, follow for the sizes that anyone would store. Last come committed policies of the eight tasks of table
4.1 that have OTR (6), whose trees are rounded to 8, 12 and 16 bits: seconds for certificate and verification, cells,
and the error that is proved. Where it is known, the time of the revision before thin sides were left out is the peer.

Targets: 32 neurons and 3 inputs in under 4 s; as many leaves as affinitree; no slower, and 3 times faster for 32 x 3
and 16 x 8; wide inputs no slower and under 500 MB, on a box 452-8-4 in under 3 s, 784-6-4-10 in under 10 s, both under
300 MB; every tree of 16 bits proved in under 20 s. With 6 neurons neither takes more than a millisecond, ours for calls
of numpy; it misses by a part of one.
"""

import contextlib
import io
import time
from math import comb

import numpy as np
import torch
from torch import nn

import otr
from benchmarks.mapping import random_network
from benchmarks.measure import Entry, peak_bytes, results_dir
from benchmarks.rounding import rounded_tree
from pipelines.play.actor_files import load_actor

torch.set_num_threads(1)

NEURONS, INPUTS = (6, 8, 16, 32), (2, 3, 8, 17)
WIDE = ((180, 8, 1), (452, 8, 1), (784, 6, 4, 10), (784, 8, 8, 10))  # inputs, neurons of each layer, outputs
WIDE_BOX = {(452, 8, 4): 3, (784, 6, 4, 10): 10}  # and the seconds that they may take
ROUNDED = {
    "reacher": "standard-fleet/seed-0",
    "walker2d": "standard-ars/seed-5",
    "hopper": "standard-ars/seed-0~6a693ba4",
    "halfcheetah": "standard-fleet/seed-0",
    "ant": "standard-fleet/seed-0",
    "swimmer": "standard-ars/seed-0",
    "bipedalwalker": "standard/seed-0",
    "pendulum": "standard-fleet/seed-0",
}
BOXES = {"pendulum": ([-1.0, -1.0, -8.0], [1.0, 1.0, 8.0])}  # of the others [-2, 2]
BEFORE, BEFORE_S = "revision 9efc0bec, measured once", {("hopper", 12): 200.0}  # with 3,726 cells
MAX_ROUNDED_S = 20
MAX_LEAVES = 2**20
MAX_MB, MAX_BOX_MB = 500, 300
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
    for widths in WIDE[:1] if quick else WIDE:
        entries += _wide(widths, 1 if quick else ROUNDS)
    for widths in list(WIDE_BOX)[:1] if quick else WIDE_BOX:
        entries += _wide_box(widths)
    for n, d in ((6, 2), (8, 3)) if quick else ((6, 8), (8, 3), (16, 3), (32, 3)):
        entries += _certificate(n, d)
    for task in ("pendulum",) if quick else ROUNDED:
        for bits in (16,) if quick else (8, 12, 16):
            entries += _rounded(task, bits)
    return entries


def network_of(*widths: int) -> otr.ReluNetwork:
    """Return a network in general position: inputs, neurons of each layer, outputs."""
    return random_network(widths, np.random.default_rng(widths))


def affinitree_seconds(network: otr.ReluNetwork) -> tuple[float, int]:
    """Return the CPU seconds that affinitree takes for a network's tree, and the number of its leaves."""
    import affinitree  # has no wheel for Python 3.13

    modules: list[nn.Module] = []
    for W, b in zip(network.weights, network.biases, strict=True):
        linear = nn.Linear(*W.T.shape).double()
        with torch.no_grad():
            linear.weight.copy_(torch.tensor(W))
            linear.bias.copy_(torch.tensor(b))
        modules += [linear, nn.ReLU()]
    architecture = affinitree.extract_pytorch_architecture(network.n_inputs, nn.Sequential(*modules[:-1]))
    with contextlib.redirect_stdout(io.StringIO()):
        began = time.process_time()
        tree = affinitree.builder.from_layers(architecture)
        seconds = time.process_time() - began
    return seconds, tree.num_terminals()


def compare(network: otr.ReluNetwork, rounds: int) -> tuple[float, int, float, int]:
    """Return the fewest seconds of a network's tree and its leaves, and affinitree's, of some rounds in turn."""
    ours, theirs = [], []
    for _ in range(rounds):
        began = time.process_time()
        tree = otr.minimal_tree(network)
        ours.append(time.process_time() - began)
        seconds, n_leaves = affinitree_seconds(network)
        theirs.append(seconds)
    return min(ours), tree.n_leaves, min(theirs), n_leaves


def _minimal(n: int, d: int, rounds: int) -> list[Entry]:
    ours, our_leaves, theirs, their_leaves = compare(network_of(d, n, 1), rounds)
    what = f"{n} neurons, {d} inputs"
    target = "ratio <= 0.333" if (n, d) in ((32, 3), (16, 8)) else "ratio <= 1"
    seconds = Entry(f"{what}: minimal tree", ours, "s", "affinitree 0.23", theirs, target)
    leaves = Entry(f"{what}: leaves", our_leaves, "leaves", "affinitree 0.23", their_leaves, "ratio <= 1", clock=None)
    print(f"exact: {what} done", flush=True)
    if (n, d) == (32, 3):
        return [seconds, Entry(f"{what}: minimal tree, at most", ours, "s", target="value <= 4"), leaves]
    return [seconds, leaves]


def _wide(widths: tuple[int, ...], rounds: int) -> list[Entry]:
    """Return the seconds and leaves of a network of many inputs, and the peak memory of its tree's making."""
    ours, our_leaves, theirs, their_leaves = compare(network_of(*widths), rounds)
    what = "-".join(map(str, widths))
    network = network_of(*widths)
    peak = peak_bytes(lambda: otr.minimal_tree(network)) / 1e6
    print(f"exact: {what} done", flush=True)
    return [
        Entry(f"{what}: minimal tree", ours, "s", "affinitree 0.23", theirs, "ratio <= 1"),
        Entry(f"{what}: leaves", our_leaves, "leaves", "affinitree 0.23", their_leaves, "ratio <= 1", clock=None),
        Entry(f"{what}: peak memory", peak, "MB", target=f"value <= {MAX_MB}", clock=None),
    ]


def _wide_box(widths: tuple[int, ...]) -> list[Entry]:
    """Return the seconds and peak memory of the tree on [-1, 1]^d of a network of many inputs, proved and verified."""
    network, box = network_of(*widths), (-1.0, 1.0)

    def proved() -> otr.ObliqueTree:
        tree = otr.minimal_tree(network, box)
        otr.verify(otr.certify(tree, network, box), tree, network)
        return tree

    began = time.process_time()
    tree = proved()
    seconds = time.process_time() - began
    what = f"{'-'.join(map(str, widths))}, [-1, 1]: {tree.n_leaves:,} leaves"
    print(f"exact: {what} done", flush=True)
    return [
        Entry(f"{what}: tree, certificate and verification", seconds, "s", target=f"value <= {WIDE_BOX[widths]}"),
        Entry(f"{what}: peak memory", peak_bytes(proved) / 1e6, "MB", target=f"value <= {MAX_BOX_MB}", clock=None),
    ]


def _certificate(n: int, d: int) -> list[Entry]:
    """Return the seconds for a certificate on the box [-1, 1]^d and for its verification."""
    network, box = network_of(d, n, 1), (-1.0, 1.0)
    tree = otr.minimal_tree(network, box)
    what = f"{n} neurons, {d} inputs, [-1, 1]: {tree.n_leaves:,} leaves"
    began = time.process_time()
    certificate = otr.certify(tree, network, box)
    certified = time.process_time()
    otr.verify(certificate, tree, network)
    verified = time.process_time()
    print(f"exact: certificate of {n} x {d} done", flush=True)
    return [
        Entry(f"{what}: certificate", certified - began, "s"),
        Entry(f"{what}: certificate verified", verified - certified, "s"),
    ]


def _rounded(task: str, bits: int) -> list[Entry]:
    """Return the seconds for a certificate of a task's tree with rounded coefficients, its cells and its error."""
    folder = results_dir() / "runs" / task / "otr" / "depth-6" / ROUNDED[task] / "train"
    network = load_actor(folder)
    assert isinstance(network, otr.ReluNetwork)
    low, high = (np.broadcast_to(end, network.n_inputs) for end in BOXES.get(task, (-2.0, 2.0)))
    tree = rounded_tree(otr.minimal_tree(network, (low, high)), low, high, bits)
    began = time.process_time()
    certificate = otr.certify(tree, network, (low, high), max_error=2.0 ** (12 - bits))
    certified = time.process_time()
    otr.verify(certificate, tree, network)
    before = BEFORE_S.get((task, bits))
    print(f"exact: {task} in {bits} bits done", flush=True)
    return [
        Entry(
            f"{task}, OTR (6), {bits} bits: {tree.n_leaves:,} leaves certified",
            certified - began,
            "s",
            None if before is None else BEFORE,
            before,
            f"value <= {MAX_ROUNDED_S}" if bits == 16 else None,
            details={
                "cells": len(certificate.cells),
                "max_error": certificate.max_error,
                "verified_s": time.process_time() - certified,
            },
        )
    ]
