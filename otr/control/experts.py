"""Linear experts behind a hard linear router: one affine map acts in each state, chosen by the largest of K scores."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from otr.control.label_leaves import argmax_leaves
from otr.control.soft_tree import LEAF_SCALE, as_numpy, initial_tests, substitute_inputs, with_ones
from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Identity
from otr.core.tree import ObliqueTree


class LinearExperts(nn.Module):
    """K linear experts, of which a router lets one act (I(MoE)-SAC, GECCO 2024; SMoSE, AAAI 2025).

        y(x) = A_k x + c_k,    k = argmax of z,    z_i = g_i . x + h_i

    Forwards one expert acts. Backwards the choice is straight-through, as if ``y = sum of softmax(z)_k (A_k x + c_k)``.
    It is exactly an oblique tree (`harden`): a test ``z_j - z_i <= 0`` for each pair of experts, and an expert a leaf.

    Attributes:
        router: (K, d + 1), the scores' maps, h in the last column.
        experts: (K, o, d + 1), c in the last column.
        balance: () of the last `forward`: K times the sum of (share of the states that k is chosen in) x (mean of
            softmax(z)_k) (Fedus et al. 2022, Switch Transformers, eq. 4): 1 where all are used alike, K for one alone.
    """

    balance: Tensor

    def __init__(
        self, n_inputs: int, n_outputs: int, n_experts: int, *, generator: torch.Generator | None = None
    ) -> None:
        """Draw the router as a linear layer's weights and experts near zero.

        Args:
            n_inputs: d.
            n_outputs: o.
            n_experts: K.
            generator: None for torch's own, as in torch's modules.
        """
        super().__init__()
        self.n_inputs, self.n_outputs = n_inputs, n_outputs
        self.router = nn.Parameter(initial_tests(n_experts, n_inputs, generator))
        self.experts = nn.Parameter(LEAF_SCALE * torch.randn(n_experts, n_outputs, n_inputs + 1, generator=generator))

    def forward(self, X: Tensor) -> Tensor:
        """Return the outputs (n, o) for states X (n, d)."""
        X1 = with_ones(X)
        n_experts = len(self.router)
        soft = torch.softmax(X1 @ self.router.t(), dim=1)
        hard = functional.one_hot(soft.argmax(dim=1), n_experts).to(soft.dtype)
        self.balance = n_experts * (hard.mean(dim=0) * soft.mean(dim=0)).sum()
        weights = hard + soft - soft.detach()
        answers = (X1 @ self.experts.flatten(0, 1).t()).view(len(X1), n_experts, self.n_outputs)
        return (weights[:, :, None] * answers).sum(dim=1)

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and files of the module have: not the last `balance`, which belongs to its graph."""
        return {name: value for name, value in self.__dict__.items() if name != "balance"}

    def substitute(self, shift: FloatArray, scale: FloatArray) -> None:
        """Rewrite the experts of x as those of u, where x = shift + scale u, both (d,), with float64 parameters."""
        self.double()
        substitute_inputs(self.router, shift, scale)
        substitute_inputs(self.experts, shift, scale)

    def harden(self, head: Head | None = None) -> ObliqueTree:
        """Return the oblique tree that does the same; of equal scores the first expert's, as in `forward`.

        Args:
            head: of the tree, one of real actions. None for Identity.

        Returns:
            Tree of depth K - 1 at most; its tests are those of `argmax_leaves`, K (K - 1) / 2 different ones, and its
            leaves the experts, each as often as paths lead to it.
        """
        router, experts = as_numpy(self.router), as_numpy(self.experts)
        no_nodes = np.zeros(0, dtype=np.int64)
        scores = ObliqueTree(
            no_nodes, no_nodes, np.zeros((0, self.n_inputs)), np.zeros(0), router[None, :, :-1], router[None, :, -1]
        )
        tree = argmax_leaves(scores)
        chosen = experts[tree.labels]
        return tree.replace(
            M=chosen[..., :-1], c=chosen[..., -1], labels=None, head=Identity() if head is None else head
        )
