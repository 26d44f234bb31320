"""Linear experts behind a hard linear router: one affine map acts in each state, chosen by the largest of K scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from otr.control.dagger.row_sampling import draw_rows
from otr.control.label_leaves import argmax_leaves
from otr.control.search.state_moments import scale_of
from otr.control.settings import ExpertsSettings
from otr.control.soft_trees.soft_tree import LEAF_SCALE, as_numpy, initial_tests, substitute_inputs, with_ones
from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Identity
from otr.core.tree import ObliqueTree
from otr.setting import Checked


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
            generator: None for torch's default, as in torch's modules.
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


@dataclass(frozen=True)
class ExpertsFit(ExpertsSettings, Checked):
    """The fit of a DAgger run whose imitators are linear experts, for oracles of continuous actions.

    Over rows drawn alike from the data, Adam minimises half the squared difference of the actions, in units of half
    their box, with `balance` times `LinearExperts.balance`. An answer at the box's edge asks for the edge or anything
    beyond, as the head clips it. States are standardised for the fit, constants only centred.

    Attributes:
        head: the box of the actions (`ClipBox`).
        n_experts: K.
    """

    head: Head
    n_experts: int

    def __call__(
        self, X: FloatArray, answers: FloatArray, weights: FloatArray | None, generator: np.random.Generator
    ) -> ObliqueTree:
        """Return the tree of experts fitted to states X (n, d) and what `run_dagger` says of them.

        Raises:
            ValueError: the oracle answers with labels, or its actions have no finite box.
        """
        box = None if self.head.gives_labels else self.head.limits(answers.shape[1])
        if box is None or not np.isfinite(box).all():
            raise ValueError(f"the head is {self.head!r}, expected a ClipBox with finite limits")
        low, high = box
        rows, _ = draw_rows(len(X), None, self.max_samples, generator)
        states, middle, half = np.asarray(X[rows]), (high + low) / 2, (high - low) / 2
        mean = states.mean(axis=0)
        scale = scale_of(mean, states.std(axis=0))
        wanted = np.clip((answers[rows] - middle) / half, -1.0, 1.0)
        module = self._fitted((states - mean) / scale, wanted, int(generator.integers(2**63)))
        module.substitute(-mean / scale, 1.0 / scale)
        with torch.no_grad():
            module.experts.mul_(torch.as_tensor(half)[:, None])
            module.experts[..., -1] += torch.as_tensor(middle)
        return module.harden(self.head)

    def _fitted(self, states: FloatArray, wanted: FloatArray, seed: int) -> LinearExperts:
        """Return the experts of standardised states (n, d) for actions (n, o) in [-1, 1]."""
        generator = torch.Generator().manual_seed(seed)
        X, Y = (torch.as_tensor(each, dtype=torch.float32) for each in (states, wanted))
        module = LinearExperts(X.shape[1], Y.shape[1], self.n_experts, generator=generator)
        optimiser = torch.optim.Adam(module.parameters(), lr=self.learning_rate)
        for done in range(self.n_updates):
            optimiser.param_groups[0]["lr"] = self.learning_rate * (1 - done / self.n_updates)
            chosen = torch.randint(len(X), (self.batch_size,), generator=generator)
            goal = Y[chosen]
            errors = module(X[chosen]) - goal
            beyond = ((goal >= 1) & (errors > 0)) | ((goal <= -1) & (errors < 0))
            loss = 0.5 * errors.masked_fill(beyond, 0.0).square().mean() + self.balance * module.balance
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        return module
