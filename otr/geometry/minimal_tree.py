"""The minimal tree of a network: only the paths that some states of a domain take, tests in a good order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from otr.clock import check_time, time_limit
from otr.core.arrays import BoolArray, FloatArray, IntArray, as_batch, count_rows, pack_rows, unpack_rows
from otr.core.domain import Box, Domain, as_domain
from otr.core.network import ReluNetwork, UnitForm, require_relu_network
from otr.core.pattern_tree import PatternTree, units_and_basis
from otr.core.pruning import keep_leaves
from otr.core.tree import ObliqueTree
from otr.geometry.arrangement import Regions, find_regions
from otr.geometry.balanced_order import balanced_tree

Order = Literal["layers", "balanced", "visits"]
_SAME_MAP = 1e-12  # of the size of the terms that a number is the sum of: leaves that differ by less are the same
_CHUNK = 2**12  # leaves whose terms are sized at once
_UNSEEN = 1e-3  # visits that all regions together count for, added to those of X


def minimal_tree(
    network: ReluNetwork,
    domain: Domain | Box | None = None,
    *,
    order: Order = "layers",
    X: ArrayLike | None = None,
    max_leaves: int = 2**20,
    max_seconds: float | None = None,
) -> ObliqueTree:
    """Return the tree that computes the same function as `network` on `domain` and has no empty path.

    At every state the tree equals the network to 1e-8 of the size of the terms that its outputs are sums of, rounding
    included, however thin the region. Labels are equal, but perhaps on a boundary between two or within rounding of it:
    a label that the network has on such a boundary alone is left out. A side of a test is left out only where no state
    has it, the rounding of all rows reckoned with, or where nothing but rounding, and that by less than 1e-10 in units
    of its slope, can make the test have it: so a neuron that is parallel to another, equal to it or at the domain's
    edge adds no path, and none beyond 1e150 of an open domain. What floating point cannot decide is kept, so that a
    path may be empty after all: among regions of the width of rounding and, on a domain without limits, where a proof
    takes next to nothing of the test. `otr.certify` decides in rational arithmetic. Two leaves that are each other's
    siblings and hold the same label, or map to within the rounding of its terms, are one. Where their maps differ, a
    leaf of several regions with one label has ``M = 0`` and the scores ``c`` that its label alone has.

    n hyperplanes in general position in R^d make sum_{i <= d} C(n, i) leaves (Zaslavsky 1975).

    Args:
        network: any; neurons without outgoing weight are left out.
        domain: a box (low, high) of which any side may be infinite; None is the network's own domain, or all of R^d.
        order: of the tests within a layer. "layers" takes the neurons in their order; "balanced" the one that parts the
            regions most evenly, which makes for short paths; "visits" the one that parts the states X most evenly.
        X: (n, d) states, for "visits".
        max_leaves, max_seconds: refuse to build a larger tree or to look for longer.

    Raises:
        TreeTooLargeError: a limit was met, of time a TimeLimitError; the message says how far the walk came.
        ValueError: the domain does not fit the network, the order is unknown or X is missing.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> otr.minimal_tree(net, ([-1], [1])).n_leaves, otr.map_network(net).n_leaves
        (2, 4)
    """
    if order not in ("layers", "balanced", "visits"):
        raise ValueError(f"order is {order!r}, expected 'layers', 'balanced' or 'visits'")
    if (X is None) is (order == "visits"):
        raise ValueError("order='visits' needs states X, and no other order does")
    require_relu_network(network)
    box = as_domain(network.domain if domain is None else domain, network.n_inputs)
    network = network.without_dead_neurons()
    with time_limit(max_seconds, lambda: "the regions were found, and their tree was being made"):
        regions = find_regions(network, box, max_regions=max_leaves, max_seconds=max_seconds)
        return _tree_of_regions(network, regions, order, X)


def _tree_of_regions(network: ReluNetwork, regions: Regions, order: Order, X: ArrayLike | None) -> ObliqueTree:
    """Return the tree of the regions of a network, as `minimal_tree` describes it."""
    if order == "layers":
        paths = PatternTree(network, regions.patterns)
        return merge_equal_leaves(paths.to_tree(), _sizes_of_terms(network, paths.patterns))
    packed, _ = count_rows(pack_rows(regions.patterns), np.ones(len(regions.patterns), dtype=np.int64))
    patterns = unpack_rows(packed, regions.patterns.shape[1])
    weights = np.full(len(patterns), 1 / len(patterns))
    if X is not None:
        in_order = PatternTree(network, patterns).to_tree()
        states = as_batch(X, network.n_inputs)
        weights = _UNSEEN * weights + np.bincount(in_order.apply(states), minlength=len(patterns)) / max(len(states), 1)
    return merge_equal_leaves(balanced_tree(network, patterns, weights), _sizes_of_terms(network, patterns))


def merge_equal_leaves(tree: ObliqueTree, sizes_of: Callable[[IntArray], FloatArray]) -> ObliqueTree:
    """Return the tree in which every subtree whose leaves all hold the same map, or label, is one leaf.

    `sizes_of` leaves (n,) are those of the terms of which the numbers of their maps [M | c] (n, o, d + 1) are sums:
    maps are the same to within the rounding of these.
    """
    n_nodes = tree.n_nodes
    on_leaves = (tree.children_left < 0) & (tree.children_right < 0)
    if not _same_answers(tree, ~tree.children_left[on_leaves], ~tree.children_right[on_leaves], sizes_of).any():
        return tree
    # What stands for each node, then each leaf: a leaf that it is equal to throughout, or -1.
    stands_for = np.concatenate((np.full(n_nodes, -1), np.arange(tree.n_leaves)))
    left, right = (np.where(side >= 0, side, n_nodes + ~side) for side in (tree.children_left, tree.children_right))
    for level in reversed(tree.levels):
        on_left, on_right = stands_for[left[level]], stands_for[right[level]]
        equal = (on_left >= 0) & (on_right >= 0)
        equal[equal] = _same_answers(tree, on_left[equal], on_right[equal], sizes_of)
        stands_for[level[equal]] = on_left[equal]
    merged = _pass_down(tree, np.where(stands_for < 0, np.arange(-1, -1 - len(stands_for), -1), stands_for))
    members = np.bincount(merged, minlength=tree.n_leaves)
    smaller = keep_leaves(tree, members > 0)
    return smaller if tree.labels is None else _with_label_scores(smaller, members[members > 0] > 1)


def _pass_down(tree: ObliqueTree, stands_for: IntArray) -> IntArray:
    """Return for every leaf the one that stands for the largest subtree around it that is equal throughout."""
    n_nodes = tree.n_nodes
    result = stands_for.copy()
    for level in tree.levels:
        for side in (tree.children_left, tree.children_right):
            children = np.where(side[level] >= 0, side[level], n_nodes + ~side[level])
            uniform = result[level] >= 0
            result[children[uniform]] = result[level[uniform]]
    return result[n_nodes:]


def _sizes_of_terms(network: ReluNetwork, patterns: BoolArray) -> Callable[[IntArray], FloatArray]:
    """Return what `merge_equal_leaves` needs of a tree whose leaves are the paths `patterns` (k, n_bits), in order."""
    units, _ = units_and_basis(network)
    units = UnitForm(np.abs(units.links), np.abs(units.inputs), np.abs(units.offsets), units.layer_starts)
    n = network.n_hidden
    return lambda leaves: units.forms(patterns[leaves, :n], network.negative_slope)[:, n:]


def _same_answers(
    tree: ObliqueTree, leaves: IntArray, others: IntArray, sizes_of: Callable[[IntArray], FloatArray]
) -> BoolArray:
    """Return whether pairs of leaves, (n,) each, hold the same label or, to within rounding, the same map."""
    if tree.labels is not None:
        equal: BoolArray = tree.labels[leaves] == tree.labels[others]
        return equal
    M, c = tree.M_of_basis, tree.c
    # Most pairs differ by more than this; of the others the terms are sized.
    size = _SAME_MAP * max(np.abs(M).max(initial=0.0), np.abs(c).max(initial=0.0))
    same: BoolArray = np.zeros(len(leaves), dtype=np.bool_)
    for start in range(0, len(leaves), _CHUNK):
        check_time()
        pairs = leaves[start : start + _CHUNK], others[start : start + _CHUNK]
        between = np.abs(np.concatenate((M[pairs[0]] - M[pairs[1]], (c[pairs[0]] - c[pairs[1]])[..., None]), axis=2))
        close = np.flatnonzero((between <= size).all(axis=(1, 2)))
        if close.size:
            allowed = _SAME_MAP * np.minimum(*(sizes_of(side[close]) for side in pairs))
            same[start + close] = (between[close] <= allowed).all(axis=(1, 2))
    return same


def _with_label_scores(tree: ObliqueTree, merged: BoolArray) -> ObliqueTree:
    """Return the tree whose merged leaves (n_leaves,) hold no map, but scores that have their label."""
    assert tree.labels is not None
    M, c = tree.M_of_basis.copy(), tree.c.copy()
    M[merged] = 0.0
    c[merged] = label_scores(tree.labels[merged], tree.n_outputs)
    return tree.replace(P=tree.P_of_basis, M=M, c=c, basis=tree.basis)


def label_scores(labels: IntArray, n_outputs: int) -> FloatArray:
    """Return outputs (n, o) that have the labels (n,): 1 at the label; of a single output, 1 or -1."""
    if n_outputs == 1:
        return np.where(labels > 0, 1.0, -1.0)[:, None]
    scores: FloatArray = np.eye(n_outputs)[labels]
    return scores
