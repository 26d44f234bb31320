"""TAO: tree alternating optimisation of an oblique tree's tests, one node's reduced problem at a time."""

from __future__ import annotations

import warnings
from dataclasses import KW_ONLY, dataclass
from numbers import Real
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from sklearn.svm import LinearSVC
from sklearn.tree import DecisionTreeClassifier
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils.validation import check_random_state

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.heads import Identity
from otr.core.pruning import prune_unreached
from otr.core.tree import ObliqueTree
from otr.learners.base.column_units import Units
from otr.learners.base.parameters import AT_LEAST_0, AT_LEAST_1, CLASS_WEIGHT, POSITIVE, Constraints
from otr.learners.base.single_tree import GrownClassifier, class_tree
from otr.learners.base.weights import ClassWeight
from otr.learners.cart import grow_cart
from otr.learners.growing.greedy import Test, grow

# Below this share of non-zeros the inputs are kept as a sparse matrix.
_SPARSE_BELOW = 0.25


@dataclass(eq=False, repr=False)
class TAOClassifier(GrownClassifier):
    """Oblique classification tree by TAO (Carreira-Perpinan & Tavallali 2018), 0/1 loss.

    From an initial tree whose structure stays, passes go over the nodes from the deepest level to the root. With all
    other nodes fixed, a row that reaches node i is answered rightly by the left child's subtree, the right one's, both
    or neither. Only rows where exactly one is right depend on the node's test, so the best test is the linear
    classifier of these rows with the right side as class (the reduced problem; with the 0/1 loss, each row counts as
    it is weighted). That is solved through a convex surrogate by liblinear. Leaves take the majority class of their
    rows. All sums over rows are weighted.

    The surrogate's solution is taken only if it misdirects no more of these rows than the present test, so the
    training loss never rises, whatever the penalty. If all of them belong to one side, the test becomes constant. The
    passes end when one of them lowers the training error by less than `tol`; nodes that no training row needs are
    spliced out at the end.

    The defaults are LCN's comparison: from CART, 14 passes, linear support-vector classifiers with L2 penalty and
    C = 1. The paper's sparse trees are ``penalty="l1", surrogate="logistic"``, where small C means few inputs a test.

    Cost of one pass over a tree of depth D with n rows of s non-zeros (s = d in dense data): O(n s D^2) to find the
    reduced problems, and for each level liblinear's fits on at most n rows together, O(n s) an iteration. Inputs
    with under a quarter of non-zeros are held as a sparse matrix; memory besides X is one copy of it.
    Nodes are not fitted in parallel: liblinear's random numbers are global, and processes would need copies of X.

    Args:
        max_depth: of the initial tree; None for a CART grown until its leaves are pure.
        init: "cart", or "random": oblique tests of normal random direction that halve a node's rows, whatever their
            weights.
        penalty: "l2" or "l1", on the coefficients of a node's test (and its offset, as always in liblinear).
        surrogate: "squared_hinge" (support vectors) or "logistic".
        C: the surrogate's weight against the penalty.
        max_iter: passes at most.
        tol: least fall of the training error in a pass that is followed by another.
        leaf_values: "shares" of the classes among a leaf's training rows, or "labels", 1 for the largest share and 0
            for the others. TAO knows labels alone; shares rank rows, which an area under the curve needs.
        solver_max_iter: iterations of liblinear in one fit at most; a fit that stops there is used as it is.
        class_weight: None, "balanced" or weights by class, as in scikit-learn.
        random_state: initial tree and liblinear.

    Attributes:
        tree_: the `otr.ObliqueTree`; its labels are positions in `classes_`.
        classes_: (n_classes,) the classes, sorted.
        loss_path_: training error of the initial tree and after each pass, never rising.
        n_iter_: number of passes.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        "max_depth": [AT_LEAST_1, None],
        "init": [StrOptions({"cart", "random"})],
        "penalty": [StrOptions({"l1", "l2"})],
        "surrogate": [StrOptions({"squared_hinge", "logistic"})],
        "C": [POSITIVE],
        "max_iter": [AT_LEAST_0],
        "tol": [Interval(Real, None, None, closed="neither")],
        "leaf_values": [StrOptions({"shares", "labels"})],
        "solver_max_iter": [AT_LEAST_1],
        "class_weight": CLASS_WEIGHT,
        "random_state": ["random_state"],
    }

    _: KW_ONLY
    max_depth: int | None = 6
    init: Literal["cart", "random"] = "cart"
    penalty: Literal["l1", "l2"] = "l2"
    surrogate: Literal["squared_hinge", "logistic"] = "squared_hinge"
    C: float = 1.0
    max_iter: int = 14
    tol: float = 0.005
    leaf_values: Literal["shares", "labels"] = "shares"
    solver_max_iter: int = 10_000
    class_weight: ClassWeight = None
    random_state: Any = None

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> TAOClassifier:
        """Fit on X (n, d) and classes y (n,); `sample_weight` (n,) counts a row as that many."""
        rows, labels, weights = self._checked_fit(X, y, sample_weight)
        weights = np.ones(len(rows)) if weights is None else weights
        units = Units.of(rows)
        X = units.changed(rows)
        random_state = check_random_state(self.random_state)
        start = self._initial_tree(X, labels, weights, random_state)
        alternation = _Alternation(X, labels, weights, start, self._surrogate(random_state))
        self.loss_path_ = [alternation.loss()]
        for _ in range(self.max_iter):
            alternation.run_pass()
            self.loss_path_.append(alternation.loss())
            if self.loss_path_[-2] - self.loss_path_[-1] < self.tol:
                break
        self.n_iter_ = len(self.loss_path_) - 1
        tree = prune_unreached(alternation.tree(), X)
        counts = np.zeros((tree.n_leaves, len(self.classes_)))
        np.add.at(counts, (tree.apply(X), labels), weights)
        if self.leaf_values == "labels":
            counts = np.eye(len(self.classes_))[counts.argmax(axis=1)]
        shares = counts / counts.sum(axis=1, keepdims=True)
        tree = class_tree(units.restored_tests(tree), shares)
        return self._take(tree, rows, np.eye(len(self.classes_))[labels], weights)

    def _initial_tree(
        self, X: NDArray[Any], labels: IntArray, weights: FloatArray, random_state: np.random.RandomState
    ) -> ObliqueTree:
        if self.init == "cart":
            cart = DecisionTreeClassifier(max_depth=self.max_depth, random_state=random_state)
            return grow_cart(cart, X, labels, weights)

        def halve(rows: IntArray) -> Test | None:
            if (labels[rows] == labels[rows[0]]).all():
                return None
            P = np.asarray(random_state.standard_normal(X.shape[1]))
            values = np.sort(X[rows] @ P)
            middle = len(values) // 2
            # Between two rows: a row on the boundary itself would go either way by rounding.
            return Test(P, -float(values[middle - 1] + values[middle]) / 2)

        skeleton = grow(X, halve, self.max_depth)
        return skeleton.with_leaves(np.zeros((len(skeleton.leaf_rows), 1)))

    def _surrogate(self, random_state: np.random.RandomState) -> LinearSVC | LogisticRegression:
        shared = {"C": self.C, "max_iter": self.solver_max_iter, "random_state": random_state}
        if self.surrogate == "squared_hinge":
            return LinearSVC(penalty=self.penalty, dual="auto" if self.penalty == "l2" else False, **shared)
        return LogisticRegression(solver="liblinear", l1_ratio=1.0 if self.penalty == "l1" else 0.0, **shared)


class _Alternation:
    """The tree under way: tests P, v and leaf labels that change, a structure that does not."""

    def __init__(
        self, X: NDArray[Any], labels: IntArray, weights: FloatArray, start: ObliqueTree, surrogate: Any
    ) -> None:
        is_sparse = np.count_nonzero(X) < _SPARSE_BELOW * X.size
        self._X = sparse.csr_matrix(X, dtype=np.float64) if is_sparse else np.asarray(X, dtype=np.float64)
        self._labels, self._weights = labels, weights
        self._start = start
        self._P, self._v = start.P.copy(), start.v.copy()
        self._leaf_labels = np.zeros(start.n_leaves, dtype=np.int64)
        self._surrogate = surrogate
        self._update_leaves(self._rows_by_reference())

    def tree(self) -> ObliqueTree:
        """Return the present tests, over leaves that answer their labels as numbers."""
        values = self._leaf_labels[:, None].astype(np.float64)
        M = np.zeros((*values.shape, self._start.n_inputs))
        return self._start.replace(P=self._P, v=self._v, M=M, c=values, labels=None, head=Identity())

    def loss(self) -> float:
        """Return the share of training rows, as they are weighted, that the tree answers wrongly."""
        rows = np.arange(len(self._labels))
        is_wrong = self._answers(0 if len(self._v) else ~0, rows) != self._labels
        return float(self._weights[is_wrong].sum() / self._weights.sum())

    def run_pass(self) -> None:
        """Set the leaves, then every test from the deepest level to the root, each to the best given the others."""
        # A node's rows depend on the tests above it alone, which change after it does.
        rows = self._rows_by_reference()
        self._update_leaves(rows)
        for level in reversed(self._start.levels):
            for node in level.tolist():
                if len(rows[node]):
                    self._update_test(node, rows[node])

    def _rows_by_reference(self) -> dict[int, IntArray]:
        """Return the rows that reach each node, and each leaf under its negative reference."""
        reach = {0 if len(self._v) else ~0: np.arange(len(self._labels))}
        for node in range(len(self._v)):
            rows = reach[node]
            right = self._goes_right(node, rows)
            reach[int(self._start.children_left[node])] = rows[~right]
            reach[int(self._start.children_right[node])] = rows[right]
        return reach

    def _update_leaves(self, rows: dict[int, IntArray]) -> None:
        for leaf in range(len(self._leaf_labels)):
            if len(rows[~leaf]):
                mine = rows[~leaf]
                self._leaf_labels[leaf] = np.bincount(self._labels[mine], self._weights[mine]).argmax()

    def _update_test(self, node: int, rows: IntArray) -> None:
        """Solve the node's reduced problem and keep the solution if it misdirects no more weight than the test does."""
        labels = self._labels[rows]
        left_right = (self._start.children_left[node], self._start.children_right[node])
        on_left, on_right = (self._answers(int(child), rows) == labels for child in left_right)
        decides = on_left != on_right
        rows, target = rows[decides], on_right[decides]
        if not len(rows):
            return
        if target.all() or not target.any():
            self._P[node], self._v[node] = 0.0, 1.0 if target[0] else -1.0
            return
        P, v = self._solve(rows, target)
        if not (np.isfinite(P).all() and np.isfinite(v)):
            return
        weights = self._weights[rows]
        wrong_now = weights[self._goes_right(node, rows) != target].sum()
        if weights[(self._X[rows] @ P > -v) != target].sum() <= wrong_now:
            self._P[node], self._v[node] = P, v

    def _solve(self, rows: IntArray, target: BoolArray) -> tuple[FloatArray, float]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            self._surrogate.fit(self._X[rows], target, self._weights[rows])
        return self._surrogate.coef_[0], float(self._surrogate.intercept_[0])

    def _goes_right(self, node: int, rows: IntArray) -> BoolArray:
        return np.asarray(self._X[rows] @ self._P[node] > -self._v[node])

    def _answers(self, reference: int, rows: IntArray) -> IntArray:
        """Return the labels (n,) that the subtree at `reference` gives to `rows`."""
        answers = np.empty(len(rows), dtype=np.int64)
        pending = [(reference, np.arange(len(rows)))]
        while pending:
            at, positions = pending.pop()
            if at < 0:
                answers[positions] = self._leaf_labels[~at]
            elif len(positions):
                right = self._goes_right(at, rows[positions])
                pending.append((int(self._start.children_left[at]), positions[~right]))
                pending.append((int(self._start.children_right[at]), positions[right]))
        return answers
