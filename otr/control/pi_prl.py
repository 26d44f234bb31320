"""Programs relaxed as in pi-PRL: structure and parameters are learned by gradient, then the structure is chosen."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from otr.control.label_leaves import decided_leaves
from otr.control.soft_tree import LEAF_SCALE, affine_leaves, as_numpy, initial_tests, substitute_inputs
from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.tree import ObliqueTree

Learns = Literal["all", "program", "architecture"]


class RelaxedProgram(nn.Module):
    """All programs ``E ::= C | if B then E else E`` up to a depth, mixed (Qiu & Zhu 2022).

    Hole i of the derivation, in level order, has the value

        w_C C(x) + w_if (s E_left(x) + (1 - s) E_right(x)),   (w_C, w_if) = softmax(architecture[i]),

    with C(x) affine in x and s = sigmoid(-beta (P_i . x + v_i)), so that ``P . x + v <= 0`` is the branch `then`. Holes
    at the full depth are C. Unrolled, this is a soft tree with affine leaves: x reaches a hole where it reaches a leaf
    below it, so leaf k adds up the maps of the holes on its path, each times what the architecture leaves for it.

    After `discretise` the weights of each hole are 0 and 1, and the same parameters are tuned on.

    Attributes:
        tests: (2**depth - 1, d + 1), v in the last column.
        maps: (2**(depth + 1) - 1, o, d + 1), c in the last column.
        architecture: (2**depth - 1, 2), logits of C and of `if`.
        structure: (2**depth - 1,) buffer, 1 where a hole is an `if`, 0 where it is C; -1 before `discretise`.
        beta: () buffer, how hard the tests are.
        learns: which parameters get gradients; the others get none at all, so that no optimiser moves them.
    """

    structure: Tensor
    beta: Tensor

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        depth: int,
        *,
        structure_penalty: float = 0.25,
        beta: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> None:
        """Draw tests as a linear layer's weights and maps near zero.

        The structure's logits start where every level of holes has the same weight, less the penalty. Starting with
        even odds in every hole would give half the weight to the root's C, which then learns fastest and is chosen: a
        linear policy.

        Args:
            n_inputs: d.
            n_outputs: o.
            depth: the most tests on a path.
            structure_penalty: a hole's logit of `if` starts at minus this times the hole's level, so that a deeper
                program has to earn its depth.
            beta: how hard the tests are at first.
            generator: None for torch's own.
        """
        super().__init__()
        self.depth, self.n_inputs, self.n_outputs = depth, n_inputs, n_outputs
        n_tests = 2**depth - 1
        self.tests = nn.Parameter(initial_tests(n_tests, n_inputs, generator))
        self.maps = nn.Parameter(
            LEAF_SCALE * torch.randn(2 * n_tests + 1, n_outputs, n_inputs + 1, generator=generator)
        )
        levels = torch.tensor([float(_level(hole)) for hole in range(n_tests)])
        for_if = torch.log(depth - levels) - structure_penalty * levels
        self.architecture = nn.Parameter(torch.stack((torch.zeros(n_tests), for_if), dim=1))
        self.register_buffer("structure", torch.full((n_tests,), -1, dtype=torch.int64))
        self.register_buffer("beta", torch.tensor(float(beta)))
        self.learns: Learns = "all"

    @property
    def is_discrete(self) -> bool:
        """Whether the structure has been chosen."""
        return self.depth > 0 and bool(self.structure[0] >= 0)

    def set_beta(self, beta: float) -> None:
        """Make the tests harder or softer."""
        self.beta.fill_(beta)

    def substitute(self, shift: FloatArray, scale: FloatArray) -> None:
        """Rewrite this program of x as the one of u, where x = shift + scale u, both (d,), with float64 parameters."""
        self.double()
        substitute_inputs(self.tests, shift, scale)
        substitute_inputs(self.maps, shift, scale)

    def forward(self, X: Tensor) -> Tensor:
        """Return the outputs (n, o) for states X (n, d)."""
        fixed = self.learns == "architecture"
        tests, maps = (self.tests.detach(), self.maps.detach()) if fixed else (self.tests, self.maps)
        weights, above = self.hole_weights(), tests_above(self.depth).to(maps.dtype)
        n_tests = len(tests)
        if self.is_discrete:
            is_derived = above.t() @ weights > 0
            n_tests = 2 ** _level(int(weights.nonzero()[-1])) - 1  # of the levels that the program has
            tests = tests[:n_tests] * is_derived[:n_tests, None]
        weighted = weights[: 2 * n_tests + 1, None] * maps[: 2 * n_tests + 1].flatten(1)
        on_paths = above[n_tests : 2 * n_tests + 1, :n_tests]
        leaves = torch.addmm(weighted[n_tests:], on_paths, weighted[:n_tests])
        return affine_leaves(tests, leaves.view(n_tests + 1, *maps.shape[1:]), X, self.beta)

    def hole_weights(self) -> Tensor:
        """Return what the architecture gives to each hole's C, (2**(depth + 1) - 1,); it sums to 1 on every path."""
        above, last = tests_above(self.depth).to(self.maps.dtype), self.maps.new_zeros(2**self.depth)
        if self.is_discrete:
            stops = (1 - self.structure).to(above.dtype)
            return torch.cat((stops, 1 - last)) * (above @ stops == 0)
        logits = self.architecture.detach() if self.learns == "program" else self.architecture
        to_map, to_test = torch.log_softmax(logits, dim=1).unbind(1)
        return torch.exp(torch.cat((to_map, last)) + above @ to_test)

    def discretise(self) -> None:
        """Choose C or `if` in every hole by the larger architecture weight, C where they tie; once only."""
        if not self.is_discrete:
            self.structure.copy_(self._larger())

    def harden(self, head: Head | None = None) -> ObliqueTree:
        """Return the program of the largest architecture weights, top down, as a hard tree with affine leaves.

        Args:
            head: of the tree; with `Argmax`, tests below the leaves decide the label. None for Identity.

        Returns:
            Tree of at most this depth; o - 1 levels more under `Argmax`.
        """
        is_test = np.zeros(len(self.maps), dtype=bool)
        is_test[: len(self.tests)] = (self.structure if self.is_discrete else self._larger()).cpu().numpy() == 1
        holes = _reached(is_test)
        nodes, leaves = holes[is_test[holes]], holes[~is_test[holes]]
        references = np.zeros(len(is_test), dtype=np.int64)
        references[nodes] = np.arange(len(nodes))
        references[leaves] = ~np.arange(len(leaves))
        tests, maps = as_numpy(self.tests)[nodes], as_numpy(self.maps)[leaves]
        tree = ObliqueTree(
            references[2 * nodes + 1],
            references[2 * nodes + 2],
            tests[:, :-1],
            tests[:, -1],
            maps[..., :-1],
            maps[..., -1],
        )
        return tree if head is None else decided_leaves(tree, head)

    def _larger(self) -> Tensor:
        return (self.architecture[:, 1] > self.architecture[:, 0]).long()


def _level(hole: int) -> int:
    """Return how many tests are above a hole."""
    return (hole + 1).bit_length() - 1


@lru_cache
def tests_above(depth: int) -> Tensor:
    """Return which tests are above each hole, (2**(depth + 1) - 1, 2**depth - 1), 1 or 0."""
    above = torch.zeros(2 ** (depth + 1) - 1, 2**depth - 1)
    for hole in range(1, len(above)):
        parent = (hole - 1) // 2
        above[hole] = above[parent]
        above[hole, parent] = 1.0
    return above


def _reached(is_test: np.ndarray) -> np.ndarray:
    """Return the holes that the program derives, in level order; `is_test` is over all holes."""
    reached = np.zeros(len(is_test), dtype=bool)
    reached[0] = True
    for hole in range(len(is_test)):
        if reached[hole] and is_test[hole]:
            reached[2 * hole + 1 : 2 * hole + 3] = True
    return np.flatnonzero(reached)
