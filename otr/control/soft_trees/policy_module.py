"""Finished policies as modules of torch: their numbers learn by gradient, their structure stays.

Tests are hard forwards; backwards they are soft, as the straight-through estimator has it (Bengio et al. 2013). A
tree's output is that of its leaves weighed by

    w = onehot(leaf reached) + p - stop(p),    p_k = product over the tests on the path to leaf k of sigmoid(-+beta z)

so a leaf learns in the states that reach it, and a test what its other side would give. Numbers are those of
`otr.control.search.policy_numbers`: rows of unit size over standardised states. What is zero stays zero unless `free`;
tests and leaves of a tree that are equal stay equal where they are `tied`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.nn import functional

from otr.control.search.policy_numbers import AffineRows, PolicyNumbers, policy_numbers
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree

HARDNESS = 4.0  # of a soft test, by the size of its row over standardised states


class MovingRows(nn.Module):
    """The affine forms [a | b] of n rows over c columns, of numbers that learn.

    Attributes:
        numbers: (n, c + 1) in units of their rows; those that stay as they are get no gradient.
        sizes: (n,) of the rows over standardised inputs, which stay.
    """

    sizes: Tensor
    _still: Tensor
    _factors: Tensor
    _offset_factors: Tensor
    _means: Tensor

    def __init__(self, rows: AffineRows) -> None:
        super().__init__()
        self._rows = rows
        moves, sizes = rows.moves, rows.sizes[:, None]
        is_tied = bool((rows.same_as != np.arange(len(moves))).any())
        self._same_as = torch.from_numpy(rows.same_as) if is_tied else None
        start = torch.zeros(moves.shape, dtype=torch.float64)
        start[torch.from_numpy(moves)] = torch.from_numpy(rows.start)
        self.numbers = nn.Parameter(start.to(torch.get_default_dtype()))
        for name, values in (
            ("_still", rows.original * ~moves),
            ("_factors", moves[:, :-1] * sizes / rows.units),
            ("_offset_factors", moves[:, -1] * rows.sizes),
            ("_means", rows.means),
            ("sizes", rows.sizes),
        ):
            self.register_buffer(name, torch.from_numpy(values).to(torch.get_default_dtype()), persistent=False)

    def forward(self) -> tuple[Tensor, Tensor]:
        """Return coefficients (n, c) and offsets (n,)."""
        coefficients = self.numbers[:, :-1] * self._factors
        offsets = self.numbers[:, -1] * self._offset_factors - (coefficients * self._means).sum(1)
        coefficients, offsets = coefficients + self._still[:, :-1], offsets + self._still[:, -1]
        return (
            (coefficients, offsets) if self._same_as is None else (coefficients[self._same_as], offsets[self._same_as])
        )

    def moving(self) -> Tensor:
        """Return the numbers that move, (D,) in float64, row by row."""
        return self.numbers.detach().double()[torch.from_numpy(self._rows.moves)]


class PolicyModule(nn.Module):
    """A policy's affine outputs (n, o) in states (n, d), before its head."""

    rows: nn.ModuleList

    def __init__(
        self, policy: ObliqueTree | ReluNetwork, states: ArrayLike, *, free: bool = False, tied: bool = False
    ) -> None:
        """Take the numbers of a policy.

        Args:
            policy: whose numbers learn.
            states: (n, d) states that it visits, whose means and standard deviations are the units of its inputs.
            free: whether coefficients and offsets that are zero learn, too.
            tied: whether a tree's tests that are equal, and its leaves that are, stay equal.

        Raises:
            ValueError: the policy answers with labels, or the states are none of its own.
        """
        super().__init__()
        if policy.head.gives_labels:
            raise ValueError(f"the policy answers with labels ({policy.head!r}), which have no gradient")
        given: Any = policy
        self._numbers: PolicyNumbers[Any] = policy_numbers(given, states, free=free, tied=tied)
        self.rows = nn.ModuleList(MovingRows(each) for each in self._numbers.rows)

    def policy(self) -> ObliqueTree | ReluNetwork:
        """Return the policy with the numbers that were learnt."""
        learnt: ObliqueTree | ReluNetwork = self._numbers.policy(
            torch.cat([rows.moving() for rows in self._moving]).numpy()
        )
        return learnt

    @property
    def n_numbers(self) -> int:
        """How many numbers learn."""
        return int(self._numbers.start.size)

    @property
    def _moving(self) -> Sequence[MovingRows]:
        return [rows for rows in self.rows if isinstance(rows, MovingRows)]


class NetworkModule(PolicyModule):
    """A (leaky) ReLU network."""

    def __init__(self, network: ReluNetwork, states: ArrayLike, *, free: bool = False) -> None:
        super().__init__(network, states, free=free)
        self._slope, self._dense = network.negative_slope, network.dense

    def forward(self, X: Tensor) -> Tensor:
        """Return the affine outputs (n, o) of states (n, d)."""
        *hidden, last = self._moving
        activations: list[Tensor] = []
        for rows in hidden:
            z = functional.linear(self._read(X, activations), *rows())
            activations.append(functional.leaky_relu(z, self._slope) if self._slope else torch.relu(z))
        return functional.linear(self._read(X, activations), *last())

    def _read(self, X: Tensor, activations: list[Tensor]) -> Tensor:
        """Return what a layer after these reads."""
        if not activations:
            return X
        if self._dense == "all":
            return torch.cat((*activations, X), dim=1)
        return torch.cat((activations[-1], X), dim=1) if self._dense else activations[-1]


class TreeModule(PolicyModule):
    """A tree of any shape, its tests hard forwards and soft backwards."""

    _left: Tensor
    _right: Tensor

    def __init__(
        self,
        tree: ObliqueTree,
        states: ArrayLike,
        *,
        free: bool = False,
        tied: bool = False,
        hardness: float = HARDNESS,
    ) -> None:
        super().__init__(tree, states, free=free, tied=tied)
        self._shape, self._hardness = tree.M.shape[:2], hardness
        left, right = _paths(tree)
        self.register_buffer("_left", left, persistent=False)
        self.register_buffer("_right", right, persistent=False)

    def forward(self, X: Tensor) -> Tensor:
        """Return the affine outputs (n, o) of states (n, d): of the leaf that each reaches."""
        P, v = self._moving[0]()
        z = functional.linear(X, P, v)
        n_leaves, o = self._shape
        with torch.no_grad():
            # How many tests of each path go elsewhere, below zero: none of the path to the leaf that is reached
            missed = (z <= 0).to(X.dtype) @ (self._left - self._right) - self._left.sum(0)
            leaf = missed.argmax(1)
        if not torch.is_grad_enabled():
            M, c = self._moving[1]()
            maps = torch.bmm(M.view(n_leaves, o, -1)[leaf], X.unsqueeze(2)).squeeze(2)
            outputs: Tensor = maps + c.view(n_leaves, o)[leaf]
            return outputs
        soft = self.path_shares(z)
        return self._weighed(X, functional.one_hot(leaf, n_leaves) + (soft - soft.detach()))

    def soft(self, X: Tensor) -> Tensor:
        """Return the outputs of the surrogate (n, o), of which the tests have their gradients."""
        P, v = self._moving[0]()
        return self._weighed(X, self.path_shares(functional.linear(X, P, v)))

    def path_shares(self, z: Tensor) -> Tensor:
        """Return the soft tree's shares of the leaves (n, n_leaves), for values (n, n_tests) of the tests."""
        sizes = self._moving[0].sizes * (1 / self._hardness)
        z = z / sizes
        left = functional.logsigmoid(-z)  # and right is left + z
        return (left @ (self._left + self._right) + z @ self._right).exp()

    def _weighed(self, X: Tensor, weights: Tensor) -> Tensor:
        n_leaves, o = self._shape
        values = functional.linear(X, *self._moving[1]()).view(-1, n_leaves, o)
        return torch.bmm(weights.unsqueeze(1), values).squeeze(1)


def _paths(tree: ObliqueTree) -> tuple[Tensor, Tensor]:
    """Return, (n_tests, n_leaves) each, which tests' left and right sides the paths to the leaves take."""
    left, right = (torch.zeros(tree.n_nodes, tree.n_leaves) for _ in range(2))
    if tree.n_nodes:
        waiting: list[tuple[int, list[tuple[int, int]]]] = [(0, [])]
        while waiting:
            node, path = waiting.pop()
            if node < 0:
                for test, side in path:
                    (left, right)[side][test, ~node] = 1.0
                continue
            for side, children in enumerate((tree.children_left, tree.children_right)):
                waiting.append((int(children[node]), [*path, (node, side)]))
    return left, right


def policy_module(
    policy: ObliqueTree | ReluNetwork, states: ArrayLike, *, free: bool = False, tied: bool = False
) -> PolicyModule:
    """Return the module of a tree or a network; see `PolicyModule`."""
    if isinstance(policy, ObliqueTree):
        return TreeModule(policy, states, free=free, tied=tied)
    return NetworkModule(policy, states, free=free)
