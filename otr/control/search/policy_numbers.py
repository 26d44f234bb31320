"""The numbers of a finished policy as one vector, in units in which steps are comparable.

Every row of a policy, a test [P | v], a leaf's output [M | c] or a neuron [W | b], is an affine form of what it reads.
It is written for standardised states and divided by its size there:

    a . x + b = r (theta . s + theta_0),  s = (x - mean) / deviation,  |(theta, theta_0)| = 1

and theta is searched, while the size r stays. ReLU is positively homogeneous, so what reads a neuron reads it divided
by its size. What is zero stays zero unless `free`: a row without an offset is not centred, and reads x divided by its
root mean square. A tree of `otr.control.LinearExperts` repeats its tests and leaves, which are one each where `tied`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import BoolArray, FloatArray, IntArray, as_batch
from otr.core.head import Head
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree

Policy = TypeVar("Policy", ObliqueTree, ReluNetwork)

CONSTANT = 1e-6  # a component that deviates by less, relative to its mean, counts as constant


class PolicyNumbers(Generic[Policy]):
    """The numbers of a policy that are searched.

    Attributes:
        start: (D,) the vector of the policy itself, its rows of unit size.
        rows: its parts, the tests and the leaves of a tree, the layers of a network.
    """

    def __init__(
        self, original: Policy, rows: Sequence[AffineRows], rebuilt: Callable[[list[FloatArray]], Policy]
    ) -> None:
        self._original: Policy = original
        self.rows = rows
        self._rebuilt: Callable[[list[FloatArray]], Policy] = rebuilt
        self.start: FloatArray = np.concatenate([each.start for each in rows])

    def policy(self, vector: ArrayLike) -> Policy:
        """Return the policy with other numbers (D,); at the start the original itself."""
        numbers = np.asarray(vector, dtype=np.float64)
        if numbers.shape != self.start.shape:
            raise ValueError(f"the vector has shape {numbers.shape}, expected {self.start.shape}")
        if np.array_equal(numbers, self.start):
            return self._original
        parts = np.split(numbers, np.cumsum([len(each.start) for each in self.rows])[:-1])
        return self._rebuilt([each.forms(part) for each, part in zip(self.rows, parts, strict=True)])


def policy_numbers(
    policy: Policy, states: ArrayLike, *, free: bool = False, tied: bool = False
) -> PolicyNumbers[Policy]:
    """Return the numbers of a policy that are searched: tests and leaves of a tree, all layers of a network.

    Of a tree with labels only the tests are. The outputs of a `PidBox` that are the terms P, I, D stay as they are.

    Args:
        policy: a tree or a network.
        states: (n, d) states that it visits, whose means and standard deviations are the units of its inputs.
        free: whether coefficients and offsets that are zero move, too.
        tied: whether a tree's tests that are equal, and its leaves that are, stay equal.

    Raises:
        TypeError: the policy is neither.
        ValueError: there are no states, or they are not finite or of another shape.
    """
    if not isinstance(policy, ObliqueTree | ReluNetwork):
        raise TypeError(
            f"the policy is a {type(policy).__name__}, expected an ObliqueTree or a ReluNetwork; "
            "of a PatternTree give its network"
        )
    X = as_batch(states, policy.n_inputs)
    if not len(X) or not np.isfinite(X).all():
        raise ValueError("there are no states, or numbers that are not finite; give those that the policy visits")
    return (
        _tree_numbers(policy, X, free, tied) if isinstance(policy, ObliqueTree) else _network_numbers(policy, X, free)
    )


class AffineRows:
    """Affine forms [a | b] of n rows over c columns that are read, as they are searched.

    Attributes:
        start: (D,) the numbers that move, row by row.
        sizes: (n,) what each row is divided by.
        original: (n, c + 1) the forms at the start.
        moves: (n, c + 1) which numbers move.
        same_as: (n,) the row whose form each one has, itself where it is not tied to an earlier one.
        means, units: (n, c) what the columns are shifted and divided by.
    """

    def __init__(
        self,
        forms: FloatArray,
        means: FloatArray,
        deviations: FloatArray,
        *,
        free: bool,
        spare_size: float = 1.0,
        still: BoolArray | None = None,
        same_as: IntArray | None = None,
    ) -> None:
        """Take the units of the columns, (c,) each.

        Args:
            forms: (n, c + 1).
            means, deviations: of what the columns read.
            free: whether zeros move, too.
            spare_size: of a row of zeros where all rows are; else it is the other rows' root mean square.
            still: (n,) rows that do not move.
            same_as: (n,) the row whose form each one has; None for itself.
        """
        self.original = forms
        self.same_as: IntArray = np.arange(len(forms)) if same_as is None else same_as
        self.moves = np.full(forms.shape, fill_value=True) if free else forms != 0
        if still is not None:
            self.moves[still] = False
        self.moves[self.same_as != np.arange(len(forms))] = False
        centred = self.moves[:, -1:]
        constant = deviations <= CONSTANT * np.abs(means)
        root_mean_squares = np.hypot(means, deviations)
        self.means = np.where(centred, means, 0.0)
        self.units = np.where(
            centred,
            np.where(constant, 1.0, deviations),
            np.where(root_mean_squares > 0, root_mean_squares, 1.0),
        )
        offsets = forms[:, -1] + (forms[:, :-1] * self.means).sum(axis=1)
        scaled = np.column_stack((forms[:, :-1] * self.units, offsets))
        self.sizes: FloatArray = np.linalg.norm(scaled, axis=1)
        others = self.sizes[self.sizes > 0]
        self.sizes[self.sizes == 0] = np.sqrt(np.mean(others**2)) if len(others) else spare_size
        self.start: FloatArray = (scaled / self.sizes[:, None])[self.moves]

    def forms(self, numbers: FloatArray) -> FloatArray:
        """Return the forms (n, c + 1) with other numbers (D,)."""
        scaled = np.zeros(self.original.shape)
        scaled[self.moves] = numbers
        scaled *= self.sizes[:, None]
        coefficients = scaled[:, :-1] / self.units
        offsets = scaled[:, -1] - (coefficients * self.means).sum(axis=1)
        rows: FloatArray = np.where(self.moves, np.column_stack((coefficients, offsets)), self.original)
        return rows[self.same_as]


def _tree_numbers(tree: ObliqueTree, X: FloatArray, free: bool, tied: bool) -> PolicyNumbers[ObliqueTree]:
    units = X.mean(axis=0), X.std(axis=0)
    rows = [AffineRows(tree.test_forms, *units, free=free, same_as=_first_equal(tree.test_forms) if tied else None)]
    if tree.labels is None:
        n_leaves, o, d = tree.M.shape
        rows.append(
            AffineRows(
                tree.leaf_forms.reshape(n_leaves * o, d + 1),
                *units,
                free=free,
                spare_size=_output_size(tree.head, o),
                still=np.tile(_terms(tree.head, o), n_leaves),
                same_as=(o * _first_equal(tree.leaf_forms)[:, None] + np.arange(o)).ravel() if tied else None,
            )
        )

    def rebuilt(forms: list[FloatArray]) -> ObliqueTree:
        changes = {"P": forms[0][:, :-1], "v": forms[0][:, -1]}
        if tree.labels is None:
            leaves = forms[1].reshape(*tree.M.shape[:2], -1)
            changes |= {"M": leaves[..., :-1], "c": leaves[..., -1]}
        return tree.replace(**changes)

    return PolicyNumbers(tree, rows, rebuilt)


def _first_equal(forms: FloatArray) -> IntArray:
    """Return the first of the forms (n, ...) that each one is equal to, (n,)."""
    _, first, kinds = np.unique(forms.reshape(len(forms), -1), axis=0, return_index=True, return_inverse=True)
    same_as: IntArray = first[kinds.ravel()]  # of numpy 2.0 the inverse is a column
    return same_as


def _network_numbers(network: ReluNetwork, X: FloatArray, free: bool) -> PolicyNumbers[ReluNetwork]:
    mean, deviation = X.mean(axis=0), X.std(axis=0)
    last, o = len(network.weights) - 1, network.n_outputs
    rows: list[AffineRows] = []
    for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        first = 0 if network.dense == "all" else max(layer - 1, 0)
        neurons = np.concatenate([each.sizes for each in rows[first:]] or [np.zeros(0)])
        inputs = np.zeros(0) if layer and network.dense is False else mean
        rows.append(
            AffineRows(
                np.column_stack((W, b)),
                np.concatenate((np.zeros(len(neurons)), inputs)),
                np.concatenate((neurons, deviation[: len(inputs)])),
                free=free,
                spare_size=_output_size(network.head, o) if layer == last else 1.0,
                still=_terms(network.head, o) if layer == last else None,
            )
        )

    def rebuilt(forms: list[FloatArray]) -> ReluNetwork:
        return network.replace(weights=[form[:, :-1] for form in forms], biases=[form[:, -1] for form in forms])

    return PolicyNumbers(network, rows, rebuilt)


def _terms(head: Head, n_outputs: int) -> BoolArray:
    """Return which outputs (o,) are terms that a head weighs by the others."""
    return np.arange(n_outputs) < head.n_terms(n_outputs)


def _output_size(head: Head, n_outputs: int) -> float:
    """Return half the range of clipped actions, and 1 for outputs that are squashed, compared or unlimited."""
    limits = head.limits(n_outputs) if head.is_projection else None
    return 1.0 if limits is None else float(np.mean(limits[1] - limits[0]) / 2)
