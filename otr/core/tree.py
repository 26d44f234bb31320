"""ObliqueTree: the one representation that every method ends in."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from functools import cached_property
from reprlib import repr as shortened
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.core.arrays import FloatArray, IntArray, as_states, read_only, with_read_only_arrays
from otr.core.head import Head
from otr.core.heads import Identity
from otr.core.leaf_maps import LeafMaps
from otr.core.routing import Router
from otr.errors import InvalidTreeError

if TYPE_CHECKING:
    from scipy import sparse


class ObliqueTree:
    """A tree with oblique tests and affine leaves, held as parallel arrays.

    Test node i sends a state x left where ``P[i] @ x + v[i] <= 0``, else right. A child reference >= 0 is a test node,
    a reference r < 0 is the leaf ``~r``. Leaf k computes ``M[k] @ x + c[k]``; the answer is the head of that or, if the
    tree has labels, ``labels[k]``: then the tests have decided, and M, c still hold the outputs (logits) behind it.

    Invariants, verified by `check`:
        * the root is node 0, or leaf 0 in a tree without tests;
        * a child's index is above its parent's;
        * every node but the root, and every leaf, has exactly one parent, so n_leaves = n_nodes + 1;
        * all numbers are finite and all shapes agree.

    A test is evaluated in float64. Batch and single-state evaluation may order a sum differently, so a state within
    rounding error (about 1e-16 of the terms' size) of a test's boundary may be sent either way.

    Attributes:
        children_left, children_right: (n_nodes,) int64.
        P, v: (n_nodes, d) and (n_nodes,) float64, the tests.
        M, c: (n_leaves, o, d) and (n_leaves, o) float64, the leaves.
        labels: (n_leaves,) int64, or None.
        basis: (r, d), where tests and maps are held as sums of few rows, so that wide inputs take little memory; else
            None. `P` and `M` are computed on access.
        P_of_basis, M_of_basis: (n_nodes, r) and (n_leaves, o, r), tests and maps of ``basis @ x``; P and M without one.
        head: from a leaf's value to the answer.
        feature_names, output_names: of the inputs, and of the outputs or labels, which programs and pictures show by
            default; None for none.

    Examples:
        >>> M, c = [[[1.0, 0.0]], [[0.0, -1.0]]], [[0.0], [1.0]]
        >>> tree = otr.ObliqueTree([~0], [~1], P=[[1.0, 1.0]], v=[-1.0], M=M, c=c)  # if x + y <= 1: x, else 1 - y
        >>> tree.predict([[0.5, 0.0], [0.5, 3.0]])
        array([[ 0.5],
               [-2. ]])
        >>> tree.apply([[0.5, 0.0], [0.5, 3.0]])  # the leaves
        array([0, 1])
    """

    def __init__(
        self,
        children_left: ArrayLike,
        children_right: ArrayLike,
        P: ArrayLike,
        v: ArrayLike,
        M: ArrayLike,
        c: ArrayLike,
        *,
        labels: ArrayLike | None = None,
        head: Head | None = None,
        basis: ArrayLike | None = None,
        feature_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
    ) -> None:
        """Keep the arrays, uncopied where they already are float64 or int64 and contiguous, and check them.

        With `basis` (r, d), `P` is (n_nodes, r) and `M` (n_leaves, o, r): the tests and maps of ``basis @ x``.

        Raises:
            InvalidTreeError: an invariant is broken.
        """
        self.children_left = _array(children_left, np.int64)
        self.children_right = _array(children_right, np.int64)
        self.basis: FloatArray | None = None if basis is None else _array(basis, np.float64)
        self.P_of_basis: FloatArray = _array(P, np.float64)
        self.v: FloatArray = _array(v, np.float64)
        self.M_of_basis: FloatArray = _array(M, np.float64)
        self.c: FloatArray = _array(c, np.float64)
        self.labels: IntArray | None = None if labels is None else _array(labels, np.int64)
        self.head: Head = Identity() if head is None else head
        self.feature_names = None if feature_names is None else tuple(feature_names)
        self.output_names = None if output_names is None else tuple(output_names)
        self.check()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(with_read_only_arrays(state))

    @cached_property
    def P(self) -> FloatArray:
        """The tests' normals (n_nodes, d)."""
        return self.P_of_basis if self.basis is None else read_only(self.P_of_basis @ self.basis)

    @cached_property
    def M(self) -> FloatArray:
        """The leaves' maps (n_leaves, o, d)."""
        return self.M_of_basis if self.basis is None else read_only(self.M_of_basis @ self.basis)

    @property
    def test_forms(self) -> FloatArray:
        """The tests as affine forms [P | v]: (n_nodes, d + 1)."""
        return np.column_stack((self.P, self.v))

    @property
    def leaf_forms(self) -> FloatArray:
        """The leaves' maps as affine forms [M | c]: (n_leaves, o, d + 1)."""
        return np.concatenate((self.M, self.c[:, :, None]), axis=2)

    @property
    def n_nodes(self) -> int:
        """Number of test nodes."""
        return len(self.v)

    @property
    def n_leaves(self) -> int:
        """Number of leaves."""
        return len(self.c)

    @property
    def n_inputs(self) -> int:
        """Number of inputs d."""
        return int((self.M_of_basis if self.basis is None else self.basis).shape[-1])

    @property
    def n_outputs(self) -> int:
        """Number of affine outputs o."""
        return int(self.M_of_basis.shape[1])

    @property
    def n_answers(self) -> int:
        """Number of labels, or of values in an answer."""
        count = self.head.n_answers if self.labels is None else self.head.n_labels
        return count(self.n_outputs)

    @cached_property
    def depth(self) -> int:
        """Number of tests on the longest path."""
        return len(self.levels)

    def get_depth(self) -> int:
        """Return `depth`, under scikit-learn's name."""
        return self.depth

    def get_n_leaves(self) -> int:
        """Return `n_leaves`, under scikit-learn's name."""
        return self.n_leaves

    @cached_property
    def levels(self) -> tuple[IntArray, ...]:
        """Test nodes by distance from the root: levels[j] holds the ids of the nodes at depth j, ascending."""
        levels = []
        level = np.arange(min(self.n_nodes, 1), dtype=np.int64)
        while level.size:
            levels.append(level)
            children = np.concatenate((self.children_left[level], self.children_right[level]))
            level = np.sort(children[children >= 0])
        return tuple(levels)

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the answers: (n, o) values or (n,) labels; without the first axis for one state (d,)."""
        if self.labels is not None:
            return np.asarray(self.labels[self.apply(X)])
        return self.head(self.forward(X))

    def forward(self, X: ArrayLike) -> FloatArray:
        """Return the leaves' affine outputs, before the head: (n, o), or (o,) for one state (d,)."""
        states = self._in_basis(X)
        if states.ndim == 1:
            leaf = self._router.leaf_of(states)
            outputs: FloatArray = self.M_of_basis[leaf].dot(states)
            outputs += self.c[leaf]
            return outputs
        return self._leaf_maps(states, self._router.leaves_of(states))

    def apply(self, X: ArrayLike) -> IntArray:
        """Return the leaf that each state ends in: (n,) int64, or a 0-d array for one state (d,)."""
        states = self._in_basis(X)
        if states.ndim == 1:
            return np.asarray(self._router.leaf_of(states), dtype=np.int64)
        return self._router.leaves_of(states)

    def decision_path(self, X: ArrayLike) -> sparse.csr_matrix:
        """Return the test nodes that each state passes: a sparse 0/1 matrix (n, n_nodes), node ids ascending by row."""
        from scipy import sparse

        states = np.atleast_2d(self._in_basis(X))
        rows, nodes = self._router.paths_of(states)
        shape = (len(states), self.n_nodes)
        return sparse.csr_matrix((np.ones(len(rows), dtype=np.int8), (rows, nodes)), shape=shape)

    def _in_basis(self, X: ArrayLike) -> FloatArray:
        """Return states as the tests and maps are held."""
        states = as_states(X, self.n_inputs)
        return states if self.basis is None else np.asarray(states @ self.basis.T)

    @cached_property
    def _router(self) -> Router:
        return Router(self.children_left, self.children_right, self.P_of_basis, self.v)

    @cached_property
    def _leaf_maps(self) -> LeafMaps:
        return LeafMaps(self.M_of_basis, self.c)

    def _repr_svg_(self) -> str:
        """Return the picture that a notebook shows: `otr.to_svg` of the tree."""
        svg: str = importlib.import_module("otr").to_svg(self)  # drawn on a floor above this one
        return svg

    def replace(self, **changes: Any) -> ObliqueTree:
        """Return the tree with other arrays or another head, checked like any tree, and all else as it is.

        ``tree.replace(c=2 * tree.c)`` doubles the leaves' offsets. Names stay while there are as many as inputs, or
        answers.

        Args:
            changes: the constructor's arguments by name. `P` and `M` are given in the inputs, as the attributes of
                these names are: a tree with a basis then is without one, unless `basis` is given, too.

        Raises:
            InvalidTreeError: the changed tree breaks an invariant.
            TypeError: a tree has no such argument.
        """
        keeps_basis = changes["basis"] is not None if "basis" in changes else not {"P", "M"} & changes.keys()
        fields: dict[str, Any] = {
            "children_left": self.children_left,
            "children_right": self.children_right,
            "P": self.P_of_basis if keeps_basis else self.P,
            "v": self.v,
            "M": self.M_of_basis if keeps_basis else self.M,
            "c": self.c,
            "labels": self.labels,
            "head": self.head,
            "basis": self.basis if keeps_basis else None,
        }
        changed = ObliqueTree(**fields | changes)
        for name, n in (("feature_names", changed.n_inputs), ("output_names", changed.n_answers)):
            own = getattr(self, name)
            if name not in changes and own is not None and len(own) == n:
                setattr(changed, name, own)
        return changed

    def compose(self, A: FloatArray, a: FloatArray) -> ObliqueTree:
        """Return the tree that answers on x as this one does on the features A x + a.

        ``P @ (A x + a) + v`` is ``(P A) @ x + (v + P @ a)``, and likewise in the leaves.

        Args:
            A, a: (n_inputs, d) and (n_inputs,).

        Raises:
            ValueError: A or a is of another shape.
        """
        P, M = self.P @ A, self.M @ A
        return self.replace(P=P, v=self.v + self.P @ a, M=M, c=self.c + self.M @ a, feature_names=None)

    def check(self) -> None:
        """Verify the invariants in the class's docstring.

        Raises:
            InvalidTreeError: names the array and what is wrong with it.
        """
        self._check_shapes()
        numbers = {"P": self.P_of_basis, "v": self.v, "M": self.M_of_basis, "c": self.c, "basis": self.basis}
        for name, array in numbers.items():
            if array is not None and not np.isfinite(array).all():
                raise InvalidTreeError(f"{name} holds a number that is not finite (NaN or infinite)")
        n_labels = self.head.n_labels(self.n_outputs)
        if self.labels is not None and self.head.gives_labels and not np.isin(self.labels, np.arange(n_labels)).all():
            raise InvalidTreeError(f"labels hold {shortened(self.labels.tolist())}, expected numbers below {n_labels}")
        n_nodes = self.n_nodes
        children = np.stack((self.children_left, self.children_right), axis=1)
        if n_nodes and (children.max() >= n_nodes or children.min() < -self.n_leaves):
            raise InvalidTreeError(
                f"a child reference lies outside {-self.n_leaves} .. {n_nodes - 1}, "
                f"the range for {n_nodes} nodes and {self.n_leaves} leaves"
            )
        below = (children >= 0) & (children <= np.arange(n_nodes)[:, None])
        if below.any():
            node = int(np.flatnonzero(below.any(axis=1))[0])
            raise InvalidTreeError(f"node {node} has the child {children[node].max()}; a child's index must be higher")
        parents = np.bincount(children.ravel() + self.n_leaves, minlength=self.n_leaves + n_nodes)
        expected = np.ones_like(parents)
        expected[self.n_leaves : self.n_leaves + 1] = 0  # the root node
        if n_nodes and not np.array_equal(parents, expected):
            reference = int(np.flatnonzero(parents != expected)[0]) - self.n_leaves
            what = f"node {reference}" if reference >= 0 else f"leaf {~reference}"
            n_parents = parents[reference + self.n_leaves]
            raise InvalidTreeError(f"{what} has {n_parents} parents, expected one (the root node: none)")

    def _check_shapes(self) -> None:
        P, M = self.P_of_basis, self.M_of_basis
        if M.ndim != 3 or P.ndim != 2 or self.v.ndim != 1:
            raise InvalidTreeError(
                f"P, v, M have {P.ndim}, {self.v.ndim}, {M.ndim} axes, expected 2, 1, 3: "
                "(n_nodes, d), (n_nodes,), (n_leaves, o, d)"
            )
        n_leaves, o, d = M.shape
        if self.basis is not None and (self.basis.ndim != 2 or len(self.basis) != d):
            raise InvalidTreeError(f"basis has shape {self.basis.shape}, expected ({d}, n_inputs): M has {d} columns")
        n_nodes = n_leaves - 1
        expected = {
            "children_left": (n_nodes,),
            "children_right": (n_nodes,),
            "P": (n_nodes, d),
            "v": (n_nodes,),
            "c": (n_leaves, o),
        }
        if self.labels is not None:
            expected["labels"] = (n_leaves,)
        for name, shape in expected.items():
            array = P if name == "P" else getattr(self, name)
            if array.shape != shape:
                raise InvalidTreeError(
                    f"{name} has shape {array.shape}, expected {shape} "
                    f"in a tree of {n_leaves} leaves, {o} outputs and {d} inputs"
                )
        if n_leaves == 0 or o == 0:
            raise InvalidTreeError(f"a tree needs at least one leaf and one output, got {n_leaves} and {o}")
        self.head.check(o)
        for name, n in (("feature_names", self.n_inputs), ("output_names", self.n_answers)):
            given = getattr(self, name)
            if given is not None and (len(given) != n or not all(isinstance(one, str) for one in given)):
                raise InvalidTreeError(f"{name} is {shortened(given)}, expected {n} texts")

    def __repr__(self) -> str:
        return (
            f"ObliqueTree(n_leaves={self.n_leaves}, depth={self.depth}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, head={self.head!r})"
        )


def _array(values: ArrayLike, dtype: type) -> NDArray[Any]:
    array: NDArray[Any] = np.ascontiguousarray(values, dtype=dtype)
    if dtype is np.int64 and not np.array_equal(array, np.asarray(values)):
        raise InvalidTreeError(f"{shortened(np.asarray(values).tolist())} holds a number that is not whole")
    return read_only(array)


def require_tree(tree: object) -> None:
    """Raise TypeError for anything but an ObliqueTree."""
    if not isinstance(tree, ObliqueTree):
        raise TypeError(
            f"tree is a {type(tree).__name__}, expected an ObliqueTree; otr.map_network makes one of a network, and a "
            "PatternTree has to_tree()"
        )
