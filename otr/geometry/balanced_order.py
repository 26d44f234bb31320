"""The order of tests in a tree made from paths: within each layer, the test that parts what is left most evenly."""

from __future__ import annotations

import numpy as np

from otr.clock import check_time
from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree, tree_of_paths
from otr.core.tree import ObliqueTree


def balanced_tree(network: ReluNetwork, patterns: BoolArray, weights: FloatArray) -> ObliqueTree:
    """Return the tree of distinct paths (k, n_bits) whose nodes part the weights (k,) as evenly as their layer allows.

    All nodes of a level are made at once: a node is a run of `rows`, all of whose paths agree in the layers above.
    """
    n_bits = patterns.shape[1]
    layer_of_bit = _layer_of_bit(network, n_bits)
    rows, starts = np.arange(len(patterns)), np.zeros(1, dtype=np.int64)
    references = np.zeros(1, dtype=np.int64)  # 2 * parent + side of each run; the root has no parent
    paths, bits = [], []
    n_nodes = 0
    left, right = np.zeros(len(patterns) - 1, dtype=np.int64), np.zeros(len(patterns) - 1, dtype=np.int64)
    while rows.size:
        check_time()
        sizes = np.diff(starts, append=len(rows))
        is_leaf = sizes == 1
        ids = np.where(is_leaf, ~rows[starts], n_nodes + np.cumsum(~is_leaf) - 1)
        if n_nodes:
            for side, target in ((0, left), (1, right)):
                of_side = references % 2 == side
                target[references[of_side] // 2] = ids[of_side]
        rows = rows[np.repeat(~is_leaf, sizes)]
        if not rows.size:
            break
        starts = np.concatenate(([0], np.cumsum(sizes[~is_leaf])[:-1]))
        bit = _most_even_bit(patterns[rows], weights[rows], starts, layer_of_bit)
        paths.append(rows[starts])
        bits.append(bit)
        sizes = sizes[~is_leaf]
        run = np.repeat(np.arange(len(starts)), sizes)
        side = patterns[rows, bit[run]]
        order = np.lexsort((side, run))
        rows, key = rows[order], (2 * run + side)[order]
        starts = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1])))
        references = 2 * n_nodes + key[starts]
        n_nodes += len(bit)
    if not paths:
        return PatternTree(network, patterns).to_tree()
    return tree_of_paths(network, patterns, left, right, np.concatenate(paths), np.concatenate(bits))


def _layer_of_bit(network: ReluNetwork, n_bits: int) -> IntArray:
    """Return the layer of each hidden neuron's test; each of the head's tests is a layer of its own."""
    of_neurons = np.repeat(np.arange(len(network.hidden_widths)), network.hidden_widths)
    n_of_head = n_bits - network.n_hidden
    return np.concatenate((of_neurons, len(network.hidden_widths) + np.arange(n_of_head))).astype(np.int64)


def _most_even_bit(patterns: BoolArray, weights: FloatArray, starts: IntArray, layer_of_bit: IntArray) -> IntArray:
    """Return, for each run of paths, the bit of the first layer in which they differ that parts their weights best."""
    totals = np.add.reduceat(weights, starts)[:, None]
    on_right = np.add.reduceat(patterns * weights[:, None], starts, axis=0)
    counts = np.add.reduceat(patterns, starts, axis=0, dtype=np.int64)
    sizes = np.diff(starts, append=len(weights))[:, None]
    differs = (counts > 0) & (counts < sizes)
    layer = np.where(differs, layer_of_bit, len(layer_of_bit)).min(axis=1, keepdims=True)
    uneven = np.where(differs & (layer_of_bit == layer), np.abs(on_right - totals / 2), np.inf)
    return np.asarray(uneven.argmin(axis=1))
