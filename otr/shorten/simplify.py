"""Shorter programs: numbers of a tree dropped and rounded, tests taken out or refitted, leaves made constant.

Every change is tried on its own and kept if the program gets shorter and the caller's judge allows it: a
bound on the actions' change over a domain (`within`), or a return measured in the environment. What is tried first
saves most: whole tests, then whole leaves, then single coefficients by the size of their effect, then digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray, as_batch
from otr.core.domain import Box, Domain, as_domain
from otr.core.tree import ObliqueTree, require_tree
from otr.programs.merging import merge_equal_leaves
from otr.proof.action_difference import largest_difference
from otr.proof.head_bounds import require_decided
from otr.shorten import edits as shorter
from otr.shorten.edits import n_numbers
from otr.shorten.refit_tests import rounded

Judge = Callable[[ObliqueTree], bool]
DIGITS = (1, 2, 3, 4)


@dataclass(frozen=True)
class Simplification:
    """The outcome of a simplification.

    Attributes:
        tree: the simpler tree.
        n_numbers_before, n_numbers: coefficients and constants that its program shows.
        n_tried, n_kept: changes.
    """

    tree: ObliqueTree
    n_numbers_before: int
    n_numbers: int
    n_tried: int
    n_kept: int


def simplify(
    tree: ObliqueTree, judge: Judge, X: ArrayLike, *, refit: bool | Iterable[int] = True, digits: Iterable[int] = DIGITS
) -> Simplification:
    """Return the shortest tree that a greedy search finds and the judge accepts.

    Args:
        tree: any; best a pruned one.
        judge: says whether a tree still does what it should.
        X: (n, d) states that the policy visits: their spread says which coefficients matter least, their mean actions
            what a leaf may be as a constant, and tests are refitted on them.
        refit: whether tests are refitted by sparse linear discriminant analysis (`otr.refit_tests`), or which of those
            that are left once tests have been taken out, by number.
        digits: significant digits to try, from the fewest.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: X is empty, not finite or of the wrong shape; or a number of digits is below 1.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: 1.001 else: 1", ["x"])
        >>> states = np.linspace(-1, 1, 50)[:, None]
        >>> print(otr.to_text(otr.simplify(tree, otr.within(tree, ([-1], [1]), 0.1), states).tree))
        return 1
    """
    require_tree(tree)
    states, digits = as_batch(X, tree.n_inputs), tuple(digits)
    if not len(states) or not np.isfinite(states).all():
        raise ValueError(
            "X holds no states, or numbers that are not finite; simplify needs those that the policy visits"
        )
    if any(few < 1 for few in digits):
        raise ValueError(f"digits are {digits}, expected at least 1 each")
    search = _Shortening(tree, judge, states)
    search.take(shorter.clipped, must_save=False)
    search.take(partial(shorter.constant_leaves, X=states), repeat=True)
    search.take(shorter.without_a_test, repeat=True)
    nodes = range(search.tree.n_nodes) if refit is True else [] if refit is False else list(refit)
    for node in nodes:
        if node < search.tree.n_nodes:
            search.take(partial(shorter.refitted, node=node, X=states))
    search.drop_numbers()
    search.take(shorter.without_a_test, repeat=True)
    search.take(shorter.with_unit_tests, must_save=False)
    for node in range(search.tree.n_nodes):
        search.take(partial(shorter.turned, node=node), must_save=False)
    search.round_numbers(digits)
    simpler = shorter.without_idle_head(merge_equal_leaves(search.tree))
    return Simplification(simpler, n_numbers(tree), n_numbers(simpler), search.n_tried, search.n_kept)


def within(tree: ObliqueTree, box: Box | Domain, bound: float) -> Judge:
    """Return the judge that allows no action to change by more than `bound` anywhere in a box.

    The bound is `otr.proof.action_difference.largest_difference`: proved, and a little larger than the change itself
    under tanh. States are left out whose side of a test depends on rounding: tests whose numbers are the same to
    four units in the last place count as one, and so does a reversed test, on whose boundary states change sides.

    Raises:
        ValueError: the box is unbounded or does not fit the tree, the bound is negative or no number, or no test of the
            tree decides its labels.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: 1.001 else: 1", ["x"])
        >>> judge = otr.within(tree, ([-1], [1]), 0.1)
        >>> judge(otr.parse_program("1", ["x"])), judge(otr.parse_program("2", ["x"]))
        (True, False)
    """
    if not 0 <= bound < np.inf:
        raise ValueError(f"bound is {bound}, expected a number of at least 0")
    require_decided(tree)
    as_domain(box, tree.n_inputs).require_bounded()
    return lambda candidate: largest_difference(tree, candidate, box) <= bound


class _Shortening:
    def __init__(self, tree: ObliqueTree, judge: Judge, states: FloatArray) -> None:
        self.tree, self.judge, self.states = tree, judge, states
        self.n_tried = self.n_kept = 0

    def accepts(self, candidate: ObliqueTree) -> bool:
        self.n_tried += 1
        return self.judge(candidate)

    def keeps(self, candidate: ObliqueTree) -> bool:
        """Take a candidate if the judge accepts it, and return whether it does."""
        accepted = self.accepts(candidate)
        if accepted:
            self.tree = candidate
            self.n_kept += 1
        return accepted

    def take(
        self,
        candidates: Callable[[ObliqueTree], Iterator[ObliqueTree]],
        *,
        repeat: bool = False,
        must_save: bool = True,
    ) -> None:
        """Take the first of the candidates that is accepted; `repeat`: continue from it, until none is."""

        def first_accepted() -> bool:
            size = n_numbers(self.tree)
            return any((n_numbers(each) < size or not must_save) and self.keeps(each) for each in candidates(self.tree))

        while first_accepted() and repeat:
            pass

    def drop_numbers(self) -> None:
        """Set numbers to 0, those of the smallest effect first: as many as possible at once, then one by one."""
        order = shorter.numbers_by_effect(self.tree, self.states)
        start, together, too_many = self.tree, 0, len(order) + 1
        while too_many - together > 1:
            n = (together + too_many) // 2
            if self.keeps(shorter.with_numbers(start, order[:n], 0.0)):
                together = n
            else:
                too_many = n
        for number in order[together:].tolist():
            self.keeps(shorter.with_numbers(self.tree, np.array([number]), 0.0))

    def round_numbers(self, digits: tuple[int, ...]) -> None:
        """Round all numbers to as few digits as possible at once, then each to fewer where the judge allows that."""
        exact = shorter.numbers_of(self.tree)
        at_once = next((few for few in digits if self.keeps(shorter.of_numbers(self.tree, rounded(exact, few)))), None)
        fewer = [few for few in digits if at_once is None or few < at_once]
        for number in shorter.numbers_by_effect(self.tree, self.states).tolist():
            value = exact[number : number + 1]
            any(
                self.keeps(shorter.with_numbers(self.tree, np.array([number]), float(rounded(value, few)[0])))
                for few in fewer
            )
