"""Soft decision trees: every state goes both ways at every test, more or less, so that all parameters get gradients."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from otr.control.label_leaves import decided_leaves
from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Identity
from otr.core.mapping import perfect_tree_children
from otr.core.tree import ObliqueTree

LEAF_SCALE = 0.01  # of fresh leaves: a policy starts near uniform, as Stable-Baselines3's do


class SoftTree(nn.Module):
    """A complete binary tree of oblique tests whose output is the mean of its leaves (Silva et al. 2020).

        y(x) = sum over leaves k of p_k(x) leaf_k(x),    p(left at test i) = sigmoid(-beta (P_i . x + v_i))

    p_k is the product of the branches' probabilities on the path to leaf k. As beta grows this becomes the hard tree,
    in which ``P . x + v <= 0`` goes left.

    Attributes:
        tests: (2**depth - 1, d + 1), the tests in level order, v in the last column.
        leaves: (2**depth, o, d + 1) with affine leaves, c in the last column; (2**depth, o) with constant ones.
        beta: () buffer, how hard the tests are.
    """

    beta: Tensor

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        depth: int,
        *,
        affine_leaves: bool,
        beta: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> None:
        """Draw tests as torch draws a linear layer's weights, and leaves near zero.

        Args:
            n_inputs: d.
            n_outputs: o.
            depth: tests on each path; 0 is one leaf.
            affine_leaves: leaves are affine in x; else constant.
            beta: how hard the tests are at first.
            generator: None for torch's default, as in torch's modules.
        """
        super().__init__()
        self.depth, self.n_inputs, self.n_outputs = depth, n_inputs, n_outputs
        self.tests = nn.Parameter(initial_tests(2**depth - 1, n_inputs, generator))
        shape = (2**depth, n_outputs, n_inputs + 1) if affine_leaves else (2**depth, n_outputs)
        self.leaves = nn.Parameter(LEAF_SCALE * torch.randn(shape, generator=generator))
        self.register_buffer("beta", torch.tensor(float(beta)))

    @property
    def affine_leaves(self) -> bool:
        """Whether the leaves are affine in x."""
        return self.leaves.ndim == 3

    def set_beta(self, beta: float) -> None:
        """Make the tests harder or softer."""
        self.beta.fill_(beta)

    def substitute(self, shift: FloatArray, scale: FloatArray) -> None:
        """Rewrite this tree of x as the one of u, where x = shift + scale u, both (d,), with float64 parameters."""
        self.double()
        substitute_inputs(self.tests, shift, scale)
        if self.affine_leaves:
            substitute_inputs(self.leaves, shift, scale)

    def forward(self, X: Tensor) -> Tensor:
        """Return the outputs (n, o) for states X (n, d)."""
        if self.affine_leaves:
            return affine_leaves(self.tests, self.leaves, X, self.beta)
        _, reached = path_probabilities(_left_probabilities(self.tests, with_ones(X), self.beta))
        return reached.t() @ self.leaves

    def harden(self, head: Head | None = None, *, axis_aligned: bool = False) -> ObliqueTree:
        """Return the hard tree: its tests as they are, or each cut down to one input.

        Args:
            head: of the tree; with `Argmax` the leaves get labels: constant ones the largest logit's, affine ones by
                tests below them. None for Identity.
            axis_aligned: every test keeps the input with the largest absolute weight (see `axis_aligned_tests`).

        Returns:
            Tree of this depth, or o - 1 deeper with affine leaves under `Argmax`.
        """
        tests = as_numpy(self.tests)
        if axis_aligned:
            tests = axis_aligned_tests(tests)
        maps = as_numpy(self.leaves)
        if not self.affine_leaves:
            maps = np.concatenate((np.zeros((*maps.shape, self.n_inputs)), maps[..., None]), axis=-1)
        head = Identity() if head is None else head
        tree = ObliqueTree(
            *perfect_tree_children(self.depth),
            tests[:, :-1],
            tests[:, -1],
            maps[..., :-1],
            maps[..., -1],
            labels=head(maps[..., -1]) if head.gives_labels and not self.affine_leaves else None,
            head=head,
        )
        return decided_leaves(tree, head) if self.affine_leaves else tree


def affine_leaves(tests: Tensor, leaves: Tensor, X: Tensor, beta: Tensor) -> Tensor:
    """Return the outputs (n, o) of a soft tree with affine leaves for states X (n, d), arguments as in `SoftTree`."""
    outputs: Tensor = _AffineLeaves.apply(tests, leaves, with_ones(X), beta)  # type: ignore[no-untyped-call]
    return outputs


class _AffineLeaves(torch.autograd.Function):
    """The output of a soft tree with affine leaves: `_by_autograd` with its derivative written out, for speed.

    Autograd's bookkeeping costs as much as the arithmetic at the sizes of policies. A derivative that is to be
    differentiated again (TRPO) is left to autograd.
    """

    @staticmethod
    def forward(ctx: Any, tests: Tensor, leaves: Tensor, X1: Tensor, beta: Tensor) -> Tensor:
        left = torch.mm(tests, X1.t()).mul_(-beta).sigmoid_()
        nodes, reached = reach(left)
        maps = torch.mm(reached.t(), leaves.flatten(1)).view(len(X1), -1, X1.shape[1])
        ctx.save_for_backward(tests, leaves, X1, beta, left, nodes, reached, maps)
        return (maps * X1[:, None, :]).sum(-1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        tests, leaves, X1, beta, left, nodes, reached, maps = ctx.saved_tensors
        (at_outputs,) = gradients
        if torch.is_grad_enabled():
            inputs = [each for each, wanted in zip((tests, leaves, X1), ctx.needs_input_grad, strict=False) if wanted]
            found = iter(
                torch.autograd.grad(_by_autograd(tests, leaves, X1, beta), inputs, at_outputs, create_graph=True)
            )
            return *(next(found) if wanted else None for wanted in ctx.needs_input_grad[:3]), None
        of_tests, of_leaves, of_X1, _ = ctx.needs_input_grad
        at_maps = (at_outputs[:, :, None] * X1[:, None, :]).flatten(1)  # (n, o (d + 1))
        at_leaves = torch.mm(reached, at_maps).view_as(leaves) if of_leaves else None
        if not of_tests and not of_X1:
            return None, at_leaves, None, None
        at_left = reach_gradient(left, nodes, None, torch.mm(leaves.flatten(1), at_maps.t()))
        at_values = torch.ops.aten.sigmoid_backward(at_left, left).mul_(-beta)  # (2**depth - 1, n)
        at_X1 = torch.mm(at_values.t(), tests) + (at_outputs[:, :, None] * maps).sum(1) if of_X1 else None
        return torch.mm(at_values, X1), at_leaves, at_X1, None


def _by_autograd(tests: Tensor, leaves: Tensor, X1: Tensor, beta: Tensor) -> Tensor:
    """Return the outputs (n, o) of a soft tree with affine leaves for states with a column of ones (n, d + 1)."""
    _, reached = path_probabilities(_left_probabilities(tests, X1, beta))
    mean_maps = reached.t() @ leaves.flatten(1)  # a mean map of each state is less work than the value of each leaf
    return (mean_maps.view(len(X1), -1, X1.shape[1]) * X1[:, None, :]).sum(-1)


def initial_tests(n_tests: int, n_inputs: int, generator: torch.Generator | None) -> Tensor:
    """Return tests (n_tests, d + 1), uniform in +-1/sqrt(d) as a linear layer's weights are."""
    bound = 1.0 / math.sqrt(n_inputs)
    return torch.empty(n_tests, n_inputs + 1).uniform_(-bound, bound, generator=generator)


def with_ones(X: Tensor) -> Tensor:
    """Return states X (n, d) with a last column of ones (n, d + 1), which the offsets multiply."""
    return torch.cat((X, X.new_ones(len(X), 1)), dim=1)


def _left_probabilities(tests: Tensor, X1: Tensor, beta: Tensor) -> Tensor:
    """Return sigmoid(-beta (P . x + v)), (n_tests, n), for states with a column of ones."""
    return torch.sigmoid((tests * -beta) @ X1.t())


def axis_aligned_tests(tests: FloatArray) -> FloatArray:
    """Return tests (n_tests, d + 1) cut down to one input each (Silva et al. 2020, discretisation).

    The input k with the largest |P_k| is kept: ``sign(P_k) x_k + v / |P_k| <= 0``. A test without weights stays.
    """
    P = tests[:, :-1]
    rows, kept = np.arange(len(P)), np.abs(P).argmax(axis=1)
    weights = P[rows, kept]
    sizes = np.where(weights == 0.0, 1.0, np.abs(weights))
    cut: FloatArray = np.zeros_like(tests)
    cut[rows, kept] = np.sign(weights)
    cut[:, -1] = tests[:, -1] / sizes
    return cut


@torch.no_grad()
def substitute_inputs(maps: Tensor, shift: FloatArray, scale: FloatArray) -> None:
    """Rewrite affine maps (..., d + 1) of x, in float64, as those of u, where x = shift + scale u, both (d,)."""
    maps[..., -1] += maps[..., :-1] @ torch.as_tensor(shift)
    maps[..., :-1] *= torch.as_tensor(scale)


def as_numpy(tensor: Tensor) -> FloatArray:
    """Return a parameter's values in float64."""
    return tensor.detach().cpu().double().numpy()


def path_probabilities(left: Tensor) -> tuple[Tensor, Tensor]:
    """Return how likely each test node (2**depth - 1, n) and leaf (2**depth, n) of a complete binary tree is reached.

    Nodes and leaves are in level order, so that the children of node i of a level are 2 i and 2 i + 1 of the next:

        reach(root) = 1,  reach(left) = reach(node) left(node),  reach(right) = reach(node) - reach(left)

    `left` (2**depth - 1, n) is the probability of the left branch at every test. Tests are the first axis, so that
    every level is one block of memory. The derivative is written out for speed, in operations that can be
    differentiated again, as natural-gradient methods (TRPO) do.
    """
    nodes, leaves = _PathProbabilities.apply(left)  # type: ignore[no-untyped-call]
    return nodes, leaves


def reach(left: Tensor) -> tuple[Tensor, Tensor]:
    """Return what `path_probabilities` returns, without autograd."""
    n_tests, n = left.shape
    nodes, leaves = torch.empty_like(left), left.new_empty(n_tests + 1, n)
    widths = level_widths(n_tests)
    levels = [*torch.split(nodes, widths), leaves]
    levels[0].fill_(1.0)
    for here, go_left, below in zip(levels, torch.split(left, widths), levels[1:], strict=False):
        to_left, to_right = below.view(-1, 2, n).unbind(1)
        torch.mul(here, go_left, out=to_left)
        torch.sub(here, to_left, out=to_right)
    return nodes, leaves


def reach_gradient(left: Tensor, nodes: Tensor, at_nodes: Tensor | None, at_leaves: Tensor) -> Tensor:
    """Return the gradient for `left`, given those of the nodes (None for zero) and leaves; differentiable itself."""
    n_tests, n = left.shape
    widths = level_widths(n_tests)
    own = [None] * len(widths) if at_nodes is None else list(torch.split(at_nodes, widths))
    levels: list[Tensor] = []
    below = at_leaves
    upwards = zip(torch.split(left, widths)[::-1], torch.split(nodes, widths)[::-1], own[::-1], strict=True)
    for go_left, here, gradient in upwards:
        to_left, to_right = below.view(-1, 2, n).unbind(1)
        difference = to_left - to_right
        levels.append(here * difference)
        below = torch.addcmul(to_right, go_left, difference)
        if gradient is not None:
            below = below + gradient
    return torch.cat(levels[::-1]) if levels else torch.zeros_like(left)


class _PathProbabilities(torch.autograd.Function):
    """`path_probabilities` with its derivative."""

    @staticmethod
    def forward(ctx: Any, left: Tensor) -> tuple[Tensor, Tensor]:
        nodes, leaves = reach(left)
        ctx.save_for_backward(left, nodes)
        ctx.set_materialize_grads(False)
        return nodes, leaves

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> Tensor:
        left, nodes = ctx.saved_tensors
        at_nodes, at_leaves = gradients
        if at_leaves is None:
            at_leaves = left.new_zeros(len(left) + 1, left.shape[1])
        return reach_gradient(left, nodes, at_nodes, at_leaves)


def level_widths(n: int) -> list[int]:
    """Return how many of n nodes of a complete tree are in each level, the root's first; n is 2**depth - 1."""
    return [2**level for level in range(n.bit_length())]
