"""Questions about a tree on a box, answered exactly: the range of its actions, and whether a linear condition holds.

A leaf counts if a real point reaches it, however thin its region: where floating point cannot decide, rational
arithmetic does. Each leaf's region is a polytope and its outputs are affine there, so every question is a linear
program a leaf. A head that clips is affine in pieces; tanh is bounded by lines, and a piece is cut in two where these
are too loose (branch and bound).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from otr.clock import time_limit
from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.half_spaces import HalfSpaces
from otr.core.tree import ObliqueTree
from otr.geometry.largest_balls import largest_balls
from otr.geometry.largest_values import largest_values
from otr.geometry.regions import chunks_of_leaves, leaf_rows
from otr.proof.branch_and_bound import Search
from otr.proof.exact_cells import decide, largest_over, stacked
from otr.proof.exact_rows import TreeOnDomain
from otr.proof.head_bounds import require_decided
from otr.proof.verdict import Condition, Question, Verdict

_MAX_PIECES = 2**17


@dataclass(frozen=True)
class OutputRange:
    """The smallest and the largest value of every action on a box, and a state where it is taken, or near to which.

    Attributes:
        low, high: (o,) actions.
        low_states, high_states: (o, d).
    """

    low: FloatArray
    high: FloatArray
    low_states: FloatArray
    high_states: FloatArray


def output_range(tree: ObliqueTree, box: Box | Domain, *, max_seconds: float | None = None) -> OutputRange:
    """Return the minimum and maximum of every action over a box, to the rounding of a linear program.

    Regions are closed: where the tree jumps at a test, the value on either side counts.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, or the tree answers with labels (use
            `reachable_labels`).
        TimeLimitError: `max_seconds` were over.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> found = otr.output_range(tree, ([1], [3]))
        >>> found.low.round(6), found.high.round(6)
        (array([1.]), array([3.]))
    """
    _require_known_head(tree)
    if tree.labels is not None:
        raise ValueError("the tree answers with labels, which have no range; use reachable_labels(tree, box)")
    search = _Ranges(tree, _bounded(tree, box))
    with time_limit(max_seconds, search.reached):
        return search.run()


def reachable_labels(
    tree: ObliqueTree, box: Box | Domain | None = None, *, max_seconds: float | None = None
) -> IntArray:
    """Return the labels of the leaves that some real point of a box reaches, ascending; to 1e150 on an open side.

    Raises:
        ValueError: the tree has no labels.
        TimeLimitError: `max_seconds` were over.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: 0 else: 1", ["x"], labels=True)
        >>> otr.reachable_labels(tree, ([1], [2]))
        array([1])
    """
    require_decided(tree)
    if tree.labels is None:
        raise ValueError("the tree has no labels; use output_range(tree, box)")
    exact, labels = TreeOnDomain(tree, as_domain(box, tree.n_inputs)), list[IntArray]()
    with time_limit(
        max_seconds, lambda: f"labels {np.unique(np.concatenate([np.zeros(0, int), *labels])).tolist()} were reached"
    ):
        for leaves in chunks_of_leaves(tree, exact.domain):
            labels += [
                tree.labels[leaves[at]] for at in _reached(exact, leaves, *leaf_rows(tree, exact.domain, leaves))
            ]
    return np.unique(np.concatenate(labels))


def find_violation(
    tree: ObliqueTree,
    condition: Condition,
    box: Box | Domain,
    *,
    tolerance: float = 1e-6,
    max_pieces: int = _MAX_PIECES,
    max_seconds: float | None = None,
) -> Verdict:
    """Return a proof that a condition holds for all states of a box, or a state where it fails.

    It holds where it does at every real point of the box; a state that fails it does so under the tree's own answer.

    Args:
        tree: any tree.
        condition: with coefficients (d,) and (o,).
        box: bounded.
        tolerance: with a head that goes through tanh or exp, a condition counts as kept if it fails by no more than
            this.
        max_pieces, max_seconds: refuse to look at more, or for longer.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, the condition does not fit the tree, or the
            tolerance is no number of at least 0.
        OtrError: more than `max_pieces` regions would have to be looked at, or, a TimeLimitError, the time was over.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> condition = otr.Condition(state=[0], action=[1], bound=2)  # the action is at most 2
        >>> otr.find_violation(tree, condition, ([-1], [1])).holds
        True
        >>> otr.find_violation(tree, condition, ([-1], [3])).state
        array([3.])
    """
    _require_known_head(tree)
    if not 0 <= tolerance < np.inf:
        raise ValueError(f"tolerance is {tolerance}, expected a number of at least 0")
    search = Search(Question(tree, condition, _bounded(tree, box)), tolerance)
    with time_limit(max_seconds, search.reached):
        return search.run(max_pieces)


def check_verdict(verdict: Verdict, tree: ObliqueTree, condition: Condition, box: Box | Domain) -> None:
    """Check what `find_violation` answered, in exact arithmetic and without a solver: its proof, or where it fails.

    Raises:
        CertificateError: it is not shown; the message names the leaf.
        ValueError: as in `find_violation`.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> condition = otr.Condition(state=[0], action=[1], bound=2)  # the action is at most 2
        >>> verdict = otr.find_violation(tree, condition, ([-1], [1]))
        >>> otr.check_verdict(verdict, tree, condition, ([-1], [1]))  # raises where it is not shown
    """
    _require_known_head(tree)
    Question(tree, condition, _bounded(tree, box)).check(verdict)


def _require_known_head(tree: ObliqueTree) -> None:
    require_decided(tree)
    if not tree.head.acts_by_output:
        raise ValueError(
            f"the head {type(tree.head).__name__} multiplies outputs, which no linear program bounds; "
            "otr.control.constant_gains(tree, X) returns an affine tree with the gains averaged"
        )


def _bounded(tree: ObliqueTree, box: Box | Domain) -> Domain:
    domain = as_domain(box, tree.n_inputs)
    domain.require_bounded()
    return domain


def _reached(
    exact: TreeOnDomain, leaves: IntArray, rows: HalfSpaces, signs: NDArray[np.int8]
) -> tuple[IntArray, IntArray]:
    """Return which of some leaves a real point reaches: those in which a ball was found, and the thinner ones."""
    n, d = len(leaves), exact.tree.n_inputs
    balls = largest_balls(rows, np.arange(n), signs)
    undecided = np.flatnonzero(~balls.is_empty & (balls.radii == 0)).tolist()
    thin = [at for at in undecided if isinstance(decide(exact.rows_of_leaf(leaves[at]), d), tuple)]
    return np.flatnonzero(balls.radii > 0), np.array(thin, dtype=np.int64)


class _Ranges:
    """The largest values of a tree's negative outputs, then of its outputs, (2 o,), and where they are: (2 o, d)."""

    def __init__(self, tree: ObliqueTree, domain: Domain) -> None:
        self.tree, self.domain, self.exact = tree, domain, TreeOnDomain(tree, domain)
        self.n_values, self.n_done = 2 * tree.n_outputs, 0
        self.values, self.states = np.full(self.n_values, -np.inf), np.zeros((self.n_values, tree.n_inputs))

    def reached(self) -> str:
        return f"{self.n_done:,} of {self.tree.n_leaves:,} leaves were looked at"

    def run(self) -> OutputRange:
        o = self.tree.n_outputs
        for leaves in chunks_of_leaves(self.tree, self.domain):
            rows, signs = leaf_rows(self.tree, self.domain, leaves)
            wide, thin = _reached(self.exact, leaves, rows, signs)
            if len(wide):
                self._keep_largest(*self._of_wide(leaves[wide], rows.take(wide), signs[wide]))
            if len(thin):
                self._keep_largest(*self._of_thin(leaves[thin]))
            self.n_done += len(leaves)
        low, high = (np.asarray(self.tree.head(y)) for y in (-self.values[:o], self.values[o:]))
        return OutputRange(low, high, self.states[:o], self.states[o:])

    def _keep_largest(self, values: FloatArray, states: FloatArray) -> None:
        """Take what is larger among values (n, 2 o) at states (n, 2 o, d)."""
        best, every = values.argmax(axis=0), np.arange(self.n_values)
        larger = values[best, every] > self.values
        self.values[larger], self.states[larger] = values[best, every][larger], states[best, every][larger]

    def _of_wide(self, leaves: IntArray, rows: HalfSpaces, signs: NDArray[np.int8]) -> tuple[FloatArray, FloatArray]:
        n, n_values, domain = len(leaves), self.n_values, self.domain
        forms = domain.scaled(self.tree.leaf_forms[leaves])
        objectives = np.concatenate((-forms, forms), axis=1).reshape(n * n_values, -1)
        best = largest_values(rows, np.repeat(np.arange(n), n_values), np.repeat(signs, n_values, axis=0), objectives)
        states = np.clip(domain.unscaled(best.states), domain.low, domain.high)
        return best.values.reshape(n, n_values), states.reshape(n, n_values, -1)

    def _of_thin(self, leaves: IntArray) -> tuple[FloatArray, FloatArray]:
        values = np.zeros((len(leaves), self.n_values))
        states, forms = np.zeros((*values.shape, self.tree.n_inputs)), self.tree.leaf_forms[leaves]
        for at, leaf in enumerate(leaves.tolist()):
            rows = stacked(self.exact.rows_of_leaf(leaf), self.tree.n_inputs)
            for i, form in enumerate((*-forms[at], *forms[at])):
                values[at, i], states[at, i] = largest_over(rows, form, self.domain)
        return values, states
