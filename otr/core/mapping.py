"""OTR, exactly: from a network to the oblique tree that computes the same function."""

from __future__ import annotations

import numpy as np

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.head import Head
from otr.core.network import ReluNetwork, require_relu_network
from otr.core.tree import ObliqueTree
from otr.errors import TreeTooLargeError


def map_network(network: ReluNetwork, *, max_leaves: int = 2**16) -> ObliqueTree:
    """Return the oblique tree that computes the same function as `network` (Orfanos 2023, Alg. 3-4).

    The node at depth j tests hidden neuron j, written in the inputs: left where ``P @ x + v <= 0``. Left of it the
    neuron contributes `negative_slope` times its pre-activation to later layers, right of it the whole. A `Sign` or
    `Argmax` head adds its tests on the outputs below. All nodes of a level are made at once: they hold the affine
    forms of the units still to come, and a child's forms are its parent's plus the new neuron's contribution.

    Node i of level j has the index 2**j - 1 + i; a leaf's index is its path read as a binary number, right being 1.

    Args:
        network: n hidden neurons, d inputs, o outputs.
        max_leaves: refuse to build a larger tree.

    Returns:
        Tree of depth n (plus 1 for Sign, plus o - 1 for Argmax) with 2**depth leaves;
        ``P`` is (2**depth - 1, d), ``M`` is (2**depth, o, d).

    Raises:
        TypeError: `network` is no ReluNetwork.
        TreeTooLargeError: names the depth, the limit, and `otr.tree` as the call that works.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> otr.map_network(net)
        ObliqueTree(n_leaves=4, depth=2, n_inputs=1, n_outputs=1, head=Identity())
    """
    require_relu_network(network)
    n, d, o = network.n_hidden, network.n_inputs, network.n_outputs
    depth = n + network.head.n_tests(o)
    if 2**depth > max_leaves:
        raise TreeTooLargeError(
            f"the full tree of {n} hidden neurons has depth {depth} and 2**{depth} leaves, the limit is {max_leaves}; "
            "use otr.tree(network, states), which has the paths that states take, or raise max_leaves"
        )
    P, v = np.empty((2**depth - 1, d)), np.empty(2**depth - 1)
    M, c = _grow_hidden_levels(network, P, v)
    labels = None
    if depth > n:
        _grow_head_levels(network.head, M, c, P[2**n - 1 :], v[2**n - 1 :])
        copies = 2 ** (depth - n)
        M, c = np.repeat(M, copies, axis=0), np.repeat(c, copies, axis=0)
        labels = network.head.labels(_paths(depth - n))
        labels = None if labels is None else np.tile(labels, 2**n)
    elif network.head.labels(np.zeros((1, 0), dtype=np.bool_)) is not None:
        labels = np.zeros(2**n, dtype=np.int64)  # Argmax of one output
    left, right = perfect_tree_children(depth)
    return ObliqueTree(left, right, P, v, M, c, labels=labels, head=network.head)


def _grow_hidden_levels(network: ReluNetwork, P: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fill P and v for the hidden neurons' levels; return the leaf maps (2**n, o, d) and (2**n, o).

    At level j, forms[i, k] is the affine form of unit j + k, and the unit j is the neuron tested.
    """
    units = network.unit_form()
    forms, offsets = units.inputs[None], units.offsets[None, :, None]
    for neuron in range(network.n_hidden):
        level = slice(2**neuron - 1, 2 ** (neuron + 1) - 1)
        P[level] = forms[:, 0]
        v[level] = offsets[:, 0, 0]
        fed = units.links[neuron + 1 :, neuron]
        forms = _split(forms, fed, network.negative_slope)
        offsets = _split(offsets, fed, network.negative_slope)
    return forms, offsets[:, :, 0]


def _split(forms: FloatArray, fed: FloatArray, negative_slope: float) -> FloatArray:
    """Return both children's forms of the later units, (2 m, r - 1, d), from the forms (m, r, d) of a level.

    The neuron tested is row 0, and reaches the later unit k with the weight fed[k].
    """
    m, r, d = forms.shape
    children = np.empty((m, 2, r - 1, d))
    for side, factor in ((0, negative_slope), (1, 1.0)):
        child = children[:, side]
        if factor == 0.0:
            child[...] = forms[:, 1:]
        else:
            np.multiply((factor * fed)[:, None], forms[:, :1], out=child)
            child += forms[:, 1:]
    return children.reshape(2 * m, r - 1, d)


def _grow_head_levels(head: Head, M: FloatArray, c: FloatArray, P: FloatArray, v: FloatArray) -> None:
    """Fill P and v with the head's tests, level by level below the leaves of the hidden neurons' tree."""
    start = 0
    for test in range(head.n_tests(M.shape[1])):
        champions = head.champions(np.column_stack((_paths(test), np.zeros((2**test, 1), dtype=np.bool_))))[:, test]
        challenger = head.first_challenger + test
        level = slice(start, start + len(M) * 2**test)
        tests, thresholds = P[level].reshape(len(M), 2**test, -1), v[level].reshape(len(M), 2**test)
        tests[...] = M[:, challenger, None]
        thresholds[...] = c[:, challenger, None]
        beaten = champions >= 0
        tests[:, beaten] -= M[:, champions[beaten]]
        thresholds[:, beaten] -= c[:, champions[beaten]]
        start = level.stop


def _paths(depth: int) -> BoolArray:
    """Return all paths of a perfect tree, (2**depth, depth), in the order of its leaves; True is right."""
    numbers = np.arange(2**depth)[:, None]
    paths: BoolArray = (numbers >> np.arange(depth - 1, -1, -1)) & 1 == 1
    return paths


def perfect_tree_children(depth: int) -> tuple[IntArray, IntArray]:
    """Return the children of the perfect tree in level order, leaves as ``~leaf``."""
    n_nodes = 2**depth - 1
    left = 2 * np.arange(n_nodes, dtype=np.int64) + 1
    right = left + 1
    for children in (left, right):
        at_leaf = children >= n_nodes
        children[at_leaf] = ~(children[at_leaf] - n_nodes)
    return left, right
