"""PatternTree: the tree of a network held as the paths through it, for depths that no array could hold.

A path is a row of bits: the activation pattern of the hidden neurons, then the outcomes of the head's tests (`Sign`
one, `Argmax` o - 1). Test j sends a state right where bit j is 1. P, v, M, c follow from the network's weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.clock import check_time
from otr.core.arrays import BoolArray, FloatArray, IntArray, PackedRows, as_batch, count_rows, pack_rows, unpack_rows
from otr.core.mapping import map_network
from otr.core.network import ReluNetwork, UnitForm, require_relu_network
from otr.core.tree import ObliqueTree

_CHUNK_STATES = 2**16
_WIDE = 64  # inputs, from which on a tree is held in the basis of the weights on them
_CHUNK_BYTES = 2**24


class PatternTree:
    """The tree of `network`, in full or restricted to some paths, with the counts of how often each was taken.

    With ``patterns=None`` the tree has all 2**n_bits paths, none of them materialised, and `observe` counts the
    paths that states take. `keep` and `observed` return the tree restricted to such paths; `to_tree` builds it.

    Attributes:
        network: the network.
        is_restricted: whether the tree has only the paths in `patterns`.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> net = otr.ReluNetwork([rng.normal(size=(40, 2)), rng.normal(size=(1, 40))], [rng.normal(size=40), [0.0]])
        >>> tree = otr.PatternTree(net)
        >>> tree.n_paths == 2**40
        True
        >>> tree.observe(rng.normal(size=(100, 2))).keep(3).to_tree().n_leaves  # of the paths that most states take
        3
    """

    def __init__(
        self, network: ReluNetwork, patterns: ArrayLike | None = None, counts: ArrayLike | None = None
    ) -> None:
        """Hold all paths, or the given ones.

        Args:
            network: n hidden neurons.
            patterns: (k, n_bits) bool, distinct rows in any order; None for all paths.
            counts: (k,) how often each path was taken; None for zeros.

        Raises:
            TypeError: `network` is no ReluNetwork.
            ValueError: a shape is wrong, rows repeat, there are no rows, or counts come without patterns.
        """
        require_relu_network(network)
        self.network = network
        self.is_restricted = patterns is not None
        self._paths: PackedRows = pack_rows(np.zeros((0, self.n_bits), dtype=np.bool_))
        self._counts: IntArray = np.zeros(0, dtype=np.int64)
        self._tree: ObliqueTree | None = None
        if patterns is None:
            if counts is not None:
                raise ValueError("counts were given without patterns; give the patterns they belong to")
            return
        rows = np.asarray(patterns, dtype=np.bool_)
        weights = np.zeros(len(rows), dtype=np.int64) if counts is None else np.asarray(counts, dtype=np.int64)
        if rows.ndim != 2 or rows.shape[1] != self.n_bits or weights.shape != rows.shape[:1] or not len(rows):
            raise ValueError(
                f"patterns have shape {rows.shape} and counts {weights.shape}, expected (k, {self.n_bits}) and (k,) "
                f"with k > 0: {network.n_hidden} hidden neurons and {self.n_bits - network.n_hidden} tests of the head"
            )
        self._paths, self._counts = count_rows(pack_rows(rows), weights)
        if len(self._paths) != len(rows):
            raise ValueError(f"patterns hold {len(rows)} rows of which {len(self._paths)} are distinct; drop repeats")

    @property
    def n_bits(self) -> int:
        """Number of tests on a full path: hidden neurons and tests of the head."""
        return self.network.n_hidden + self.network.head.n_tests(self.network.n_outputs)

    @property
    def n_inputs(self) -> int:
        """Number of inputs d."""
        return self.network.n_inputs

    @property
    def n_paths(self) -> int:
        """Number of paths of the tree: 2**n_bits, or those it is restricted to."""
        return len(self._paths) if self.is_restricted else int(2**self.n_bits)

    @property
    def n_patterns(self) -> int:
        """Number a of distinct hidden activation patterns held or observed; 2**n_hidden if there is neither."""
        if not self.is_restricted and not len(self._paths):
            return int(2**self.network.n_hidden)
        hidden = pack_rows(self.patterns[:, : self.network.n_hidden])
        return len(count_rows(hidden, self._counts)[0])

    @property
    def patterns(self) -> BoolArray:
        """Paths held or observed, (k, n_bits), in lexicographic order, which is the order of `to_tree`'s leaves."""
        return unpack_rows(self._paths, self.n_bits)

    @property
    def counts(self) -> IntArray:
        """How often each row of `patterns` was taken: (k,)."""
        return self._counts.copy()

    def paths(self, X: ArrayLike) -> BoolArray:
        """Return the path of each state through the full tree: (n, n_bits)."""
        states = as_batch(X, self.n_inputs)
        patterns, outputs = self.network.patterns_and_outputs(states)
        outcomes = self.network.head.tests(outputs)
        return np.concatenate((patterns, outcomes), axis=1) if outcomes.shape[1] else patterns

    def observe(self, X: ArrayLike) -> PatternTree:
        """Count the paths of the states X (n, d), in addition to those counted before, and return self.

        In a restricted tree a state counts for the path that it ends in, following the tests that are left.
        """
        states = as_batch(X, self.n_inputs)
        if self.is_restricted:
            self._counts += np.bincount(self.to_tree().apply(states), minlength=len(self._counts))
            return self
        for start in range(0, len(states), _CHUNK_STATES):
            self.observe_paths(self.paths(states[start : start + _CHUNK_STATES]))
        return self

    def observe_paths(self, paths: BoolArray, counts: IntArray | None = None) -> PatternTree:
        """Count rows of bits (n, n_bits) of the full tree, as `observe` does for states, and return self.

        Args:
            paths: (n, n_bits) bool; rows may repeat.
            counts: (n,) how often each row was taken; None for once each.

        Raises:
            ValueError: the tree is restricted, the shapes do not fit it or each other, or a count is negative.
        """
        if self.is_restricted:
            raise ValueError("the tree is restricted to some paths; count paths in PatternTree(network)")
        weights = np.ones(len(paths), dtype=np.int64) if counts is None else counts
        if paths.shape != (len(weights), self.n_bits) or (weights < 0).any():
            raise ValueError(
                f"paths have shape {paths.shape} and there are {len(weights)} counts, expected (n, {self.n_bits}) and "
                "n of at least 0"
            )
        seen, n_seen = count_rows(pack_rows(paths), weights)
        merged = np.concatenate((self._paths, seen)), np.concatenate((self._counts, n_seen))
        self._paths, self._counts = count_rows(*merged)
        return self

    def keep(self, k: int) -> PatternTree:
        """Return the tree restricted to the k paths taken most often; ties in lexicographic order.

        Raises:
            ValueError: k < 1, or no path has been observed.
        """
        if k < 1:
            raise ValueError(f"k is {k}, expected at least 1 path to keep")
        order = np.argsort(-self._counts, kind="stable")[:k]
        return self._restricted_to(np.sort(order[self._counts[order] > 0]))

    def observed(self) -> PatternTree:
        """Return the tree restricted to the paths that have been taken.

        Raises:
            ValueError: no path has been observed.
        """
        return self._restricted_to(np.flatnonzero(self._counts > 0))

    def _restricted_to(self, rows: IntArray) -> PatternTree:
        if not rows.size:
            raise ValueError("no path has been observed; call observe(X) with states first")
        return PatternTree(self.network, self.patterns[rows], self._counts[rows])

    def forward(self, X: ArrayLike) -> FloatArray:
        """Return the affine outputs, (n, o) or (o,): the network's, or the restricted tree's."""
        return self.to_tree().forward(X) if self.is_restricted else self.network.forward(X)

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the answers, as `ObliqueTree.predict` does."""
        return self.to_tree().predict(X) if self.is_restricted else self.network.predict(X)

    def to_tree(self, *, max_leaves: int = 2**16) -> ObliqueTree:
        """Return the ObliqueTree of exactly these paths, nodes of one child spliced out.

        Leaf i is row i of `patterns`. Between neighbouring rows i, i + 1 in lexicographic order is one test node,
        at the first bit in which they differ; the node's subtree is the run of rows around it that agree up to there.

        Args:
            max_leaves: for a tree that is not restricted, as in `map_network`.

        Raises:
            TreeTooLargeError: the tree is not restricted and too large.
        """
        if not self.is_restricted:
            return map_network(self.network, max_leaves=max_leaves)
        if self._tree is None:
            self._tree = _build_tree(self.network, self.patterns)
        return self._tree

    def __repr__(self) -> str:
        paths = f"{self.n_paths} paths" if self.is_restricted else f"all 2**{self.n_bits} paths"
        return f"PatternTree({paths}, {int(self._counts.sum())} states observed, {self.network!r})"


def _build_tree(network: ReluNetwork, patterns: BoolArray) -> ObliqueTree:
    """Return the compacted tree of distinct, lexicographically sorted paths (k, n_bits)."""
    first_difference = (patterns[1:] != patterns[:-1]).argmax(axis=1) if len(patterns) > 1 else np.zeros(0, np.int64)
    left, right, order = _trie_children(first_difference)
    return tree_of_paths(network, patterns, left, right, order, first_difference[order])


def tree_of_paths(
    network: ReluNetwork, patterns: BoolArray, left: IntArray, right: IntArray, paths: IntArray, bits: IntArray
) -> ObliqueTree:
    """Return a tree whose leaves are `patterns` (k, n_bits), with the children given.

    Test node i asks for bit `bits[i]`, in the form that it has on the path `paths[i]`: (k - 1,) each.
    """
    units, basis = units_and_basis(network)
    k, d, o = len(patterns), units.inputs.shape[1], network.n_outputs
    P, v = np.empty((k - 1, d)), np.empty(k - 1)
    M, c = np.empty((k, o, d)), np.empty((k, o))
    by_path = np.argsort(paths, kind="stable")
    chunk = max(1, _CHUNK_BYTES // (8 * (d + 1) * (network.n_hidden + o)))
    for start in range(0, k, chunk):
        check_time()
        rows = slice(start, min(start + chunk, k))
        forms = units.forms(patterns[rows, : network.n_hidden], network.negative_slope)
        M[rows], c[rows] = forms[:, network.n_hidden :, :d], forms[:, network.n_hidden :, d]
        nodes = by_path[np.searchsorted(paths[by_path], start) : np.searchsorted(paths[by_path], rows.stop)]
        tests = _test_forms(network, forms[paths[nodes] - start], patterns[paths[nodes]], bits[nodes])
        P[nodes], v[nodes] = tests[:, :d], tests[:, d]
    labels = network.head.labels(patterns[:, network.n_hidden :])
    return ObliqueTree(left, right, P, v, M, c, labels=labels, head=network.head, basis=basis)


def units_and_basis(network: ReluNetwork) -> tuple[UnitForm, FloatArray | None]:
    """Return a network unit by unit, and the rows (r, d) of which its inputs are products, None for x itself.

    Of many inputs a few units read, all tests and maps are sums of these units' weights.
    """
    units = network.unit_form()
    reading = np.flatnonzero(units.inputs.any(axis=1))
    if network.n_inputs < _WIDE or 2 * len(reading) > network.n_inputs:
        return units, None
    products = np.zeros((len(units.inputs), len(reading)))
    products[reading, np.arange(len(reading))] = 1.0
    return replace(units, inputs=products), units.inputs[reading]


def _trie_children(first_difference: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return the children of the trie's test nodes, and the nodes in order of their bit (a parent's comes first).

    Node i is between the paths i and i + 1. It is the child of the nearer, in bits, of the closest node on its
    left and the closest on its right that test an earlier bit (the Cartesian tree over `first_difference`).
    """
    n_nodes = len(first_difference)
    order = np.argsort(first_difference, kind="stable")
    index = np.empty(n_nodes, dtype=np.int64)
    index[order] = np.arange(n_nodes)
    left, right = ~np.arange(n_nodes), ~np.arange(1, n_nodes + 1)
    bit_of = np.concatenate((first_difference, [-1]))  # entry -1 stands for no node
    for bit in np.unique(first_difference)[1:]:
        nodes = np.flatnonzero(first_difference == bit)
        earlier = np.concatenate(([-1], np.flatnonzero(first_difference < bit), [-1]))
        gap = np.searchsorted(earlier[1:-1], nodes)
        on_left, on_right = earlier[gap], earlier[gap + 1]
        from_left = bit_of[on_left] > bit_of[on_right]
        right[on_left[from_left]] = index[nodes[from_left]]
        left[on_right[~from_left]] = index[nodes[~from_left]]
    return left[order], right[order], order


def _test_forms(network: ReluNetwork, forms: FloatArray, patterns: BoolArray, bits: IntArray) -> FloatArray:
    """Return, for i < len(bits), the affine form (d + 1,) of test bits[i] on path i."""
    n, head = network.n_hidden, network.head
    rows = np.arange(len(bits))
    of_head = bits >= n
    tests: FloatArray = forms[rows, bits + of_head * head.first_challenger]
    rows = rows[of_head]
    champions = head.champions(patterns[rows, n:])[np.arange(len(rows)), bits[rows] - n]
    rows, champions = rows[champions >= 0], champions[champions >= 0]
    tests[rows] -= forms[rows, n + champions]
    return tests
