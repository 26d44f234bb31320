"""Prediction: many states at once against numpy's forward pass, one state at a time against Stable-Baselines3.

Measured on networks of 6 neurons (11 inputs, 3 outputs, as Hopper) and 32 neurons (27 inputs, 8 outputs, as Ant): the
whole tree as a `PatternTree`, and the tree pruned to the paths reached most. Peers: the two matrix products of the
network in numpy, and torch's forward pass in float32. One state at a time, the tree's `predict` with its tanh head
is compared with `predict` of a SAC model with the same actor.

The states are Gaussian in a few latent directions, as a controlled body visits the neighbourhood of a gait and not the
whole space, so that some paths are reached often; or Gaussian in every input alike, which spreads them over the paths.

Targets: whole tree within 1.5 times numpy's seconds, pruned tree within 4 times; one state at least 10 times the calls
per second of Stable-Baselines3.
"""

from collections.abc import Sequence

import numpy as np
import torch

import otr
from benchmarks.mapping import random_network
from benchmarks.measure import Entry, alternate, repeats_for
from benchmarks.peers import copy_layers, sac_with_actor

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
        gait = gait_states(120_000, widths[0], generator)
        spread = generator.normal(size=gait.shape)
        trees = [otr.prune_to_k(otr.PatternTree(network), X[:20_000], N_PATHS) for X in (gait, spread)]
        for n_states in (1_000, 10_000) if quick else (1_000, 10_000, 100_000):
            entries += _batch(network, trees, [gait[-n_states:], spread[-n_states:]], rounds)
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


def _batch(
    network: otr.ReluNetwork, trees: Sequence[otr.ObliqueTree], batches: Sequence[np.ndarray], rounds: int
) -> list[Entry]:
    """Return the entries of one batch size: the whole tree, and the trees pruned to gait and to spread states."""
    whole = otr.PatternTree(network)
    gait, spread = batches
    (W1, W2), (b1, b2) = network.weights, network.biases
    module, gait_tensor = torch_module(network), torch.tensor(gait, dtype=torch.float32)

    def numpy_forward() -> np.ndarray:
        return np.maximum(gait @ W1.T + b1, 0) @ W2.T + b2

    def torch_forward() -> torch.Tensor:
        with torch.no_grad():
            return module(gait_tensor)

    functions = (
        lambda: whole.predict(gait),
        lambda: trees[0].predict(gait),
        lambda: trees[1].predict(spread),
        numpy_forward,
        torch_forward,
    )
    for function in functions:
        function()  # the first call builds the tables that the others read
    *ours, numpy_s, torch_s = alternate(*functions, rounds=rounds, repeats=repeats_for(numpy_forward, 0.02))
    name = f"{len(gait):,} states, {len(W1)} neurons"
    entries = [
        Entry(f"{name}: whole tree", ours[0], "s", "numpy", numpy_s, "ratio <= 1.5"),
        Entry(f"{name}: whole tree", ours[0], "s", "torch, float32", torch_s),
    ]
    for kind, tree, seconds in zip(("gait", "spread"), trees, ours[1:], strict=True):
        label = f"{name}: tree of {tree.n_leaves} paths, {kind} states"
        entries.append(Entry(label, seconds, "s", "numpy", numpy_s, "ratio <= 4"))
    return entries


def torch_module(network: otr.ReluNetwork) -> torch.nn.Sequential:
    """Return a network of one hidden layer as torch holds it, in float32."""
    linear = [torch.nn.Linear(W.shape[1], len(W)) for W in network.weights]
    copy_layers(linear, network)
    return torch.nn.Sequential(linear[0], torch.nn.ReLU(), linear[1])


def _single(depth: int, generator: np.random.Generator, rounds: int) -> list[Entry]:
    """Return the entry of one Hopper state at a time through the tree of an actor with `depth` neurons."""
    network = random_network((11, depth, 3), generator, otr.TanhBox(-np.ones(3), np.ones(3)))
    model = sac_with_actor(network)
    states = gait_states(20_100, 11, generator)
    tree = (
        otr.map_network(network) if depth <= 6 else otr.prune_to_k(otr.PatternTree(network), states[:20_000], N_PATHS)
    )
    observations = list(states[-100:])
    network_answers, model_answers = network.predict(states[-100:]), model.predict(states[-100:], deterministic=True)[0]
    assert np.allclose(network_answers, model_answers, atol=1e-5), "the SAC model does not have the network's actor"

    def ours() -> None:
        for observation in observations:
            tree.predict(observation)

    def theirs() -> None:
        for observation in observations:
            model.predict(observation, deterministic=True)

    ours()  # builds what later calls read
    ours_s, theirs_s = alternate(ours, theirs, rounds=2 * rounds, repeats=2)
    name = f"one state, {depth} neurons: tree of {tree.n_leaves} leaves"
    rates = len(observations) / ours_s, len(observations) / theirs_s
    return [Entry(name, rates[0], "calls/s", "Stable-Baselines3 predict", rates[1], "ratio >= 10")]
