"""Prediction: many states at once against numpy's forward pass, one state at a time against Stable-Baselines3.

Measured on networks of 6 neurons (11 inputs, 3 outputs, as Hopper) and 32 neurons (27 inputs, 8 outputs, as Ant): the
whole tree as a `PatternTree`, and the tree pruned to the paths reached most. Peers: the two matrix products of the
network in numpy, and torch's forward pass in float32. One state at a time, the tree's `predict` with its tanh head
stands against `predict` of a SAC model with the same actor.

The states are Gaussian around a few latent directions: a controlled body visits the neighbourhood of a gait, not the
whole space, so that some paths are reached often.

Targets: whole tree within 1.5 times numpy's seconds, pruned tree within 4 times; one state at least 10 times the calls
per second of Stable-Baselines3.
"""

import numpy as np
import torch

import otr
from benchmarks.mapping import random_network
from benchmarks.measure import Entry, alternate, repeats_for
from benchmarks.peers import sac_with_actor

N_PATHS = 300
N_LATENT = 4
SMALL, LARGE = (11, 6, 3), (27, 32, 8)


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick leaves out the largest batch and has fewer rounds."""
    generator = np.random.default_rng(0)
    rounds = 5 if quick else 15
    entries = []
    for widths in (SMALL, LARGE):
        network = random_network(widths, generator)
        states = gait_states(120_000, widths[0], generator)
        pruned = pruned_tree(network, states[:20_000])
        for n_states in (1_000, 10_000) if quick else (1_000, 10_000, 100_000):
            entries += _batch(network, pruned, states[-n_states:], rounds)
        print(f"prediction: batches of {widths[1]} neurons done", flush=True)
    for depth in (6, 32):
        entries += _single(depth, generator, rounds)
        print(f"prediction: single states of depth {depth} done", flush=True)
    return entries


def gait_states(n_states: int, n_inputs: int, generator: np.random.Generator) -> np.ndarray:
    """Return states (n_states, n_inputs) of unit scale: N_LATENT Gaussian directions, and a little noise in all."""
    directions = generator.normal(0.0, N_LATENT**-0.5, (N_LATENT, n_inputs))
    latent = generator.normal(size=(n_states, N_LATENT))
    return latent @ directions + generator.normal(0.0, 0.05, (n_states, n_inputs))


def pruned_tree(network: otr.ReluNetwork, states: np.ndarray) -> otr.ObliqueTree:
    """Return the tree of the N_PATHS paths that the states reach most often, or of all reached where they are fewer."""
    return otr.prune_to_k(otr.PatternTree(network), states, N_PATHS)


def _batch(network: otr.ReluNetwork, pruned: otr.ObliqueTree, X: np.ndarray, rounds: int) -> list[Entry]:
    whole = otr.PatternTree(network)
    (W1, W2), (b1, b2) = network.weights, network.biases
    module = torch.nn.Sequential(
        torch.nn.Linear(W1.shape[1], len(W1)), torch.nn.ReLU(), torch.nn.Linear(len(W1), len(W2))
    )
    with torch.no_grad():
        for layer, W, b in ((module[0], W1, b1), (module[2], W2, b2)):
            layer.weight.copy_(torch.tensor(W))
            layer.bias.copy_(torch.tensor(b))
    X_torch = torch.tensor(X, dtype=torch.float32)

    def numpy_forward() -> np.ndarray:
        return np.maximum(X @ W1.T + b1, 0) @ W2.T + b2

    def torch_forward() -> torch.Tensor:
        with torch.no_grad():
            return module(X_torch)

    repeats = repeats_for(numpy_forward, 0.02)
    functions = (lambda: whole.predict(X), lambda: pruned.predict(X), numpy_forward, torch_forward)
    for function in functions:
        function()
    whole_s, pruned_s, numpy_s, torch_s = alternate(*functions, rounds=rounds, repeats=repeats)
    name = f"{len(X):,} states, {len(W1)} neurons"
    return [
        Entry(f"{name}: whole tree", whole_s, "s", "numpy", numpy_s, "ratio <= 1.5"),
        Entry(f"{name}: tree of {pruned.n_leaves} paths", pruned_s, "s", "numpy", numpy_s, "ratio <= 4"),
        Entry(f"{name}: whole tree", whole_s, "s", "torch, float32", torch_s),
        Entry(f"{name}: tree of {pruned.n_leaves} paths", pruned_s, "s", "torch, float32", torch_s),
    ]


def _single(depth: int, generator: np.random.Generator, rounds: int) -> list[Entry]:
    """Return the entry of one Hopper state at a time through the tree of an actor with `depth` neurons."""
    network = random_network((11, depth, 3), generator, otr.TanhBox(-np.ones(3), np.ones(3)))
    model = sac_with_actor(network)
    states = gait_states(20_100, 11, generator)
    tree = otr.map_network(network) if depth <= 6 else pruned_tree(network, states[:20_000])
    observations = list(states[-100:])
    network_answers, model_answers = network.predict(states[-100:]), model.predict(states[-100:], deterministic=True)[0]
    assert np.allclose(network_answers, model_answers, atol=1e-5), "the SAC model does not have the network's actor"

    def ours() -> None:
        for observation in observations:
            tree.predict(observation)

    def theirs() -> None:
        for observation in observations:
            model.predict(observation, deterministic=True)

    for function in (ours, theirs):
        function()
    ours_s, theirs_s = alternate(ours, theirs, rounds=2 * rounds, repeats=2)
    name = f"one state, {depth} neurons: tree of {tree.n_leaves} leaves"
    rates = len(observations) / ours_s, len(observations) / theirs_s
    return [Entry(name, rates[0], "calls/s", "Stable-Baselines3 predict", rates[1], "ratio >= 10")]
