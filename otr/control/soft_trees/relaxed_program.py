"""Programs relaxed as in pi-PRL: structure and parameters are learned by gradient, then the structure is chosen."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from otr.control.label_leaves import decided_leaves
from otr.control.settings import RelaxedProgramSettings
from otr.control.soft_trees.soft_tree import (
    LEAF_SCALE,
    affine_leaves,
    as_numpy,
    initial_tests,
    level_widths,
    substitute_inputs,
)
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
        structure_penalty: float = RelaxedProgramSettings.structure_penalty,
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
            structure_penalty: see `otr.control.settings.RelaxedProgramSettings`.
            beta: how hard the tests are at first.
            generator: None for torch's default.
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
        weights, going_on = self.shares()
        depth = self.depth
        if self.is_discrete:
            depth = _level(int(weights.nonzero()[-1]))  # of the program, which may reach less deep
            tests = tests[: 2**depth - 1] * (going_on[: 2**depth - 1, None] > 0)
        leaves, *below = torch.split(weights[:, None, None] * maps, level_widths(len(maps)))
        for level in below[:depth]:
            leaves = (leaves[:, None] + level.view(-1, 2, *level.shape[1:])).flatten(0, 1)
        return affine_leaves(tests, leaves, X, self.beta)

    def shares(self) -> tuple[Tensor, Tensor]:
        """Return what the architecture leaves for C in each hole, and for `if` in those that may be one.

        Returns:
            (2**(depth + 1) - 1,), which sums to 1 on every path, and (2**depth - 1,).
        """
        reach, for_map, for_test = self.maps.new_ones(1, 1), [], []
        for choices in torch.split(self._choices(), level_widths(len(self.tests))):
            here = reach * choices
            for_map.append(here[:, 0])
            for_test.append(here[:, 1])
            reach = here[:, 1:].expand(-1, 2).reshape(-1, 1)
        return torch.cat((*for_map, reach[:, 0])), torch.cat((*for_test, reach[:0, 0]))

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

    def _choices(self) -> Tensor:
        """Return the weights of C and `if` in every hole, (2**depth - 1, 2)."""
        if self.is_discrete:
            return torch.stack((1 - self.structure, self.structure), dim=1).to(self.maps.dtype)
        logits = self.architecture.detach() if self.learns == "program" else self.architecture
        return torch.softmax(logits, dim=1)

    def _larger(self) -> Tensor:
        return (self.architecture[:, 1] > self.architecture[:, 0]).long()


def _level(hole: int) -> int:
    """Return how many tests are above a hole."""
    return (hole + 1).bit_length() - 1


def _reached(is_test: np.ndarray) -> np.ndarray:
    """Return the holes that the program derives, in level order; `is_test` is over all holes."""
    reached = np.zeros(len(is_test), dtype=bool)
    reached[0] = True
    for hole in range(len(is_test)):
        if reached[hole] and is_test[hole]:
            reached[2 * hole + 1 : 2 * hole + 3] = True
    return np.flatnonzero(reached)
