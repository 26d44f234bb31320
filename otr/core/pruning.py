"""Pruned trees: OTR-hat keeps the paths that states have reached, OTR-hat(k) the k most frequent of them."""

from __future__ import annotations

import operator

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import BoolArray, FloatArray, IntArray, as_batch
from otr.core.network import ReluNetwork, require_relu_network
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree, require_tree


def tree(network: ReluNetwork, X: ArrayLike) -> ObliqueTree:
    """Return the tree of the paths that states take through a network of any width: there it is the network.

    It is `prune_unreached` of the network's `PatternTree`, and holds no more leaves than there are states. Elsewhere it
    follows the tests that are left; `certify` of a `minimal_tree` is for what holds at every state of a box.

    Args:
        network: the policy.
        X: (n, d) states, at least one, such as `rollout(...).states`.

    Raises:
        TypeError: `network` is no ReluNetwork.
        ValueError: X is empty or of the wrong width.

    Examples:
        >>> generator = np.random.default_rng(0)
        >>> wide = otr.ReluNetwork([generator.normal(size=s) for s in ((64, 3), (64, 64), (1, 64))],
        ...                        [generator.normal(size=64), generator.normal(size=64), np.zeros(1)])
        >>> states = generator.normal(size=(20, 3)) / 10
        >>> found = otr.tree(wide, states)
        >>> found.n_leaves <= 20, bool(np.allclose(found.predict(states), wide.predict(states)))
        (True, True)
    """
    require_relu_network(network)
    return prune_unreached(PatternTree(network), X)


def prune_unreached(tree: ObliqueTree | PatternTree, X: ArrayLike) -> ObliqueTree:
    """Return the tree of the paths that the states X reach: OTR-hat (Orfanos 2023, section on pruning).

    Subtrees never entered are removed, and a node with one child left is spliced out; a state of a removed path
    follows the tests that are left. On X itself the function is unchanged.

    Args:
        tree: the tree, or the `PatternTree` of a network.
        X: (n, d) states, at least one.

    Raises:
        TypeError: `tree` is neither.
        ValueError: X is empty or of the wrong width.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -1 else if x <= 1: x else: 1", ["x"])
        >>> otr.prune_unreached(tree, [[0.5], [2.0]]).n_leaves
        2
    """
    states = _states(tree, X)
    if isinstance(tree, PatternTree):
        if not tree.is_restricted:
            return _tree_of_reached_paths(tree, states)
        tree = tree.to_tree()
    return _tree_of_reached_leaves(tree, states)


def prune_to_k(tree: ObliqueTree | PatternTree, X: ArrayLike, k: int) -> ObliqueTree:
    """Return the tree of the k paths that the states X reach most often: OTR-hat(k).

    Paths of equal frequency are taken in the order of the leaves. If fewer than k paths are reached, all are kept.
    A state of a removed path follows the tests that are left, and may get another answer than before.

    Args:
        tree: the tree, or the `PatternTree` of a network.
        X: (n, d) states, at least one.
        k: number of leaves to keep, at least 1.

    Raises:
        TypeError: `tree` is neither, or k no integer.
        ValueError: X is empty or of the wrong width, or k < 1.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> otr.prune_to_k(otr.PatternTree(net), [[-1], [1], [2]], k=1)
        ObliqueTree(n_leaves=1, depth=0, n_inputs=1, n_outputs=1, head=Identity())
    """
    if operator.index(k) < 1:
        raise ValueError(f"k is {k}, expected at least 1 path to keep")
    states = _states(tree, X)
    if isinstance(tree, PatternTree):
        if not tree.is_restricted:
            return PatternTree(tree.network).observe(states).keep(k).to_tree()
        tree = tree.to_tree()
    return keep_leaves(tree, most_frequent(np.bincount(tree.apply(states), minlength=tree.n_leaves), k))


def keep_leaves(tree: ObliqueTree, keep: BoolArray) -> ObliqueTree:
    """Return the tree of the leaves where `keep` (n_leaves,) is True, in order; nodes of one child are spliced out."""
    if keep.shape != (tree.n_leaves,) or not keep.any():
        raise ValueError(
            f"keep has shape {keep.shape}, {keep.sum()} of it True; expected ({tree.n_leaves},) and one True"
        )
    n_nodes = tree.n_nodes
    # What replaces each node, then each leaf, once the rest is gone: itself, what replaces its only child, or
    # nothing (-1). A leaf is numbered n_nodes + leaf here.
    stand_in = np.concatenate((np.arange(n_nodes), np.where(keep, np.arange(n_nodes, n_nodes + tree.n_leaves), -1)))
    left, right = (np.where(side >= 0, side, n_nodes + ~side) for side in (tree.children_left, tree.children_right))
    for level in reversed(tree.levels):
        on_left, on_right = stand_in[left[level]], stand_in[right[level]]
        stand_in[level] = np.where(on_left < 0, on_right, np.where(on_right < 0, on_left, level))
    nodes = np.flatnonzero(stand_in[:n_nodes] == np.arange(n_nodes))
    leaves = np.flatnonzero(keep)
    new_reference = np.zeros(n_nodes + tree.n_leaves, dtype=np.int64)
    new_reference[nodes] = np.arange(len(nodes))
    new_reference[n_nodes + leaves] = ~np.arange(len(leaves))
    return tree.replace(
        children_left=new_reference[stand_in[left[nodes]]],
        children_right=new_reference[stand_in[right[nodes]]],
        P=tree.P_of_basis[nodes],
        v=tree.v[nodes],
        M=tree.M_of_basis[leaves],
        c=tree.c[leaves],
        labels=None if tree.labels is None else tree.labels[leaves],
        basis=tree.basis,
    )


def most_frequent(counts: IntArray, k: int) -> BoolArray:
    """Return True at the k largest counts, zeros never, ties by the lower index."""
    keep = np.zeros(len(counts), dtype=np.bool_)
    keep[np.argsort(-counts, kind="stable")[:k]] = True
    return keep & (counts > 0)


# A state on a test's boundary, to within rounding, may be sent one way by the full tree, or by the network's own
# arithmetic, and the other way by the pruned tree, which evaluates fewer tests at once and so sums in another order. If
# the path on that side had been pruned, the state would end in a leaf that is not its own. So both functions below
# give such a state the path on the side that the pruned tree sends it to, and prune again, until all states have
# settled; in a mapped network the two paths have the same value on the boundary between them.


def _tree_of_reached_leaves(tree: ObliqueTree, X: FloatArray) -> ObliqueTree:
    """Return the tree of the leaves that X reaches, such that every state of X ends in its own leaf."""
    leaves = tree.apply(X)
    for _ in range(tree.depth + 1):
        keep = np.bincount(leaves, minlength=tree.n_leaves) > 0
        pruned = keep_leaves(tree, keep)
        reached = np.flatnonzero(keep)[pruned.apply(X)]
        astray = np.flatnonzero(reached != leaves)
        if not astray.size:
            break
        parents = _parents(tree)
        for row in astray:
            leaves[row] = _leaf_across(tree, parents, X[row], int(leaves[row]), int(reached[row]))
    return pruned


def _parents(tree: ObliqueTree) -> IntArray:
    """Return each node's and leaf's parent, indexed by reference: a leaf's, being negative, count from the end."""
    parents = np.zeros(tree.n_nodes + tree.n_leaves, dtype=np.int64)
    for children in (tree.children_left, tree.children_right):
        parents[children] = np.arange(tree.n_nodes)
    return parents


def _leaf_across(tree: ObliqueTree, parents: IntArray, x: FloatArray, leaf: int, reached: int) -> int:
    """Return the leaf of x if, at the node where the paths to `leaf` and `reached` part, it is sent to the latter."""
    to_leaf, to_reached = ([~end] for end in (leaf, reached))
    for path in (to_leaf, to_reached):
        while path[-1] != 0:
            path.append(int(parents[path[-1]]))
    while to_leaf[-1] == to_reached[-1]:
        to_leaf.pop()
        to_reached.pop()
    side = to_reached[-1]
    while side >= 0:
        children = tree.children_left if tree.P[side] @ x + tree.v[side] <= 0 else tree.children_right
        side = int(children[side])
    return ~side


def _tree_of_reached_paths(tree: PatternTree, X: FloatArray) -> ObliqueTree:
    """Return the tree of the paths of X, such that every state of X ends in its own leaf."""
    paths = tree.paths(X)
    for _ in range(paths.shape[1] + 1):
        kept = PatternTree(tree.network).observe_paths(paths).observed()
        pruned = kept.to_tree()
        reached = kept.patterns[pruned.apply(X)]
        differs = reached != paths
        astray = np.flatnonzero(differs.any(axis=1))
        if not astray.size:
            break
        first = differs[astray].argmax(axis=1)
        paths[astray, first] = reached[astray, first]
    return pruned


def _states(tree: ObliqueTree | PatternTree, X: ArrayLike) -> FloatArray:
    if not isinstance(tree, PatternTree):
        require_tree(tree)
    states = as_batch(X, tree.n_inputs)
    if not len(states) or np.isnan(states).any():
        raise ValueError("X holds no states, or a NaN; pruning needs at least one to know which paths are reached")
    return states
