"""How likely a state is to reach each node of a complete soft tree, and the derivatives, level by level."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


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
    """Return what `path_probabilities` returns, out of autograd's sight."""
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
