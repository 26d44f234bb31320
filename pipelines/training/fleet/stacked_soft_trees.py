"""Stacks of soft trees of one shape: forward and backward passes written by hand, a workspace for R runs each.

They compute what the modules of `otr.control` do, which say what the parameters are; parameters and their gradients are
stacks of `stacked_tensors` by the modules' own names. States X1 have a last column of ones. The first rows alone take
part in `backward`.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Protocol

import torch
from torch import Tensor

from otr.control.sac.stacked_tensors import multiply, new_stack
from otr.control.soft_trees.cascading_tree import CascadingTree
from otr.control.soft_trees.relaxed_program import RelaxedProgram
from pipelines.training.soft_trees import SoftModule

Stacks = Mapping[str, Tensor]


class StackedTrees(Protocol):
    """The workspace for R soft trees in `n_rows` states each."""

    def forward(self, parameters: Stacks, X1: Tensor, beta: float, outputs: Tensor) -> None:
        """Write the values (R, n_rows, o) at X1 (R, n_rows, d + 1) into `outputs`."""
        ...

    def backward(
        self, parameters: Stacks, X1: Tensor, beta: float, d_outputs: Tensor, gradients: Mapping[str, Tensor]
    ) -> None:
        """Write the derivatives by the parameters, given those (R, n_back_rows, o) by the last `forward`'s values."""
        ...


def stacked_trees(modules: Sequence[SoftModule], n_rows: int, n_back_rows: int) -> StackedTrees:
    """Return the workspace for modules of one shape."""
    n, one = len(modules), modules[0]
    if isinstance(one, RelaxedProgram):
        return StackedPrograms(
            [module for module in modules if isinstance(module, RelaxedProgram)], n_rows, n_back_rows
        )
    if isinstance(one, CascadingTree):
        return StackedCascades(n, one, n_rows, n_back_rows)
    return StackedSoftTrees(n, one.tests.shape, one.leaves.shape, n_rows, n_back_rows)


class StackedSoftTrees:
    """Complete trees: parameters `tests` (R, m, d + 1) and `leaves` (R, m + 1, o, d + 1), constant (R, m + 1, o)."""

    def __init__(self, n: int, tests: Sequence[int], leaves: Sequence[int], n_rows: int, n_back_rows: int) -> None:
        """Take the shapes of one tree's tests and leaves."""
        (n_tests, n_columns), (n_leaves, *leaf) = tests, leaves
        # How likely each test sends a state left, and each test node and leaf is reached, as in `path_probabilities`.
        self._left, self._nodes = new_stack(n, n_tests, n_rows), new_stack(n, n_tests, n_rows)
        self._leaves = new_stack(n, n_leaves, n_rows)
        self._maps, self._products = new_stack(n, n_rows, *leaf), new_stack(n, n_rows, *leaf)
        self._at_maps = new_stack(n, n_back_rows, *leaf)
        self._at_left, self._at_nodes = new_stack(n, n_tests, n_back_rows), new_stack(n, n_tests, n_back_rows)
        self._at_leaves = new_stack(n, n_leaves, n_back_rows)
        self._n_back_rows, self._is_affine = n_back_rows, len(leaf) == 2
        self._d_inputs = new_stack(n, n_back_rows, n_columns)
        (self._leaves if n_tests == 0 else self._nodes)[:, 0] = 1.0
        self._forward_levels = _levels(self._nodes, self._leaves, self._nodes, self._left)
        back = self._nodes[..., :n_back_rows], self._left[..., :n_back_rows], self._at_left, self._at_nodes
        self._backward_levels = _levels(self._at_nodes, self._at_leaves, *back)[::-1]

    def forward(self, parameters: Stacks, X1: Tensor, beta: float, outputs: Tensor) -> None:
        tests, leaves = parameters["tests"], parameters["leaves"]
        multiply(tests, X1.transpose(1, 2), self._left).mul_(-beta).sigmoid_()
        for to_left, to_right, here, go_left in self._forward_levels:
            torch.mul(here, go_left, out=to_left)
            torch.sub(here, to_left, out=to_right)
        multiply(self._leaves.transpose(1, 2), leaves.flatten(2), self._maps.flatten(2))
        if self._is_affine:
            torch.mul(self._maps, X1.unsqueeze(2), out=self._products)
            torch.sum(self._products, -1, out=outputs)
        else:
            outputs.copy_(self._maps)

    def backward(
        self, parameters: Stacks, X1: Tensor, beta: float, d_outputs: Tensor, gradients: Mapping[str, Tensor]
    ) -> None:
        X1 = X1[:, : self._n_back_rows]
        if self._is_affine:
            torch.mul(d_outputs.unsqueeze(3), X1.unsqueeze(2), out=self._at_maps)
        else:
            self._at_maps.copy_(d_outputs)
        at_maps = self._at_maps.flatten(2)
        multiply(self._leaves[..., : self._n_back_rows], at_maps, gradients["leaves"].flatten(2))
        multiply(parameters["leaves"].flatten(2), at_maps.transpose(1, 2), self._at_leaves)
        for to_left, to_right, here, go_left, at_left, at_node in self._backward_levels:
            torch.sub(to_left, to_right, out=at_left)
            torch.addcmul(to_right, go_left, at_left, out=at_node)
            at_left.mul_(here)
        left = self._left[..., : self._n_back_rows]
        torch.ops.aten.sigmoid_backward.grad_input(self._at_left, left, grad_input=self._at_left).mul_(-beta)
        multiply(self._at_left, X1, gradients["tests"])

    def inputs_gradient(self, parameters: Stacks) -> Tensor:
        """Return the derivative (R, n_back_rows, d + 1) by the states after `backward`, of constant leaves alone."""
        return multiply(self._at_left.transpose(1, 2), parameters["tests"], self._d_inputs)


class StackedCascades:
    """Cascades: the parameters of two soft trees, `features.` and `decisions.`, which read what the first makes."""

    def __init__(self, n: int, one: CascadingTree, n_rows: int, n_back_rows: int) -> None:
        """Take one of the modules for its shapes."""
        trees = (one.features, one.decisions)
        self._features, self._decisions = (
            StackedSoftTrees(n, tree.tests.shape, tree.leaves.shape, n_rows, n_back_rows) for tree in trees
        )
        self._values = new_stack(n, n_rows, one.n_features + 1)
        self._values[..., -1] = 1.0

    def forward(self, parameters: Stacks, X1: Tensor, beta: float, outputs: Tensor) -> None:
        self._features.forward(_below("features.", parameters), X1, beta, self._values[..., :-1])
        self._decisions.forward(_below("decisions.", parameters), self._values, beta, outputs)

    def backward(
        self, parameters: Stacks, X1: Tensor, beta: float, d_outputs: Tensor, gradients: Mapping[str, Tensor]
    ) -> None:
        decisions = _below("decisions.", parameters)
        self._decisions.backward(decisions, self._values, beta, d_outputs, _below("decisions.", gradients))
        d_values = self._decisions.inputs_gradient(decisions)[..., :-1]
        self._features.backward(_below("features.", parameters), X1, beta, d_values, _below("features.", gradients))


class StackedPrograms:
    """Relaxed programs: `tests`, `maps` and `architecture`, whose shares are left to the modules and autograd.

    These are few numbers, which change while the architecture learns alone.
    """

    def __init__(self, modules: Sequence[RelaxedProgram], n_rows: int, n_back_rows: int) -> None:
        self._modules, one = modules, modules[0]
        n, (n_tests, n_columns), (n_holes, *leaf) = len(modules), one.tests.shape, one.maps.shape
        n_leaves = n_holes - n_tests
        self._trees = StackedSoftTrees(n, (n_tests, n_columns), (n_leaves, *leaf), n_rows, n_back_rows)
        self._tests, self._weighted = new_stack(n, n_tests, n_columns), new_stack(n, n_holes, *leaf)
        # Sums of the weighted maps from the root to each hole, and the derivatives by them, which the maps have, too.
        self._sums, self._at_sums = new_stack(n, n_holes, leaf[0] * leaf[1]), new_stack(n, n_holes, leaf[0] * leaf[1])
        leaves, self._at_leaves = (sums[:, n_tests:].view(n, n_leaves, *leaf) for sums in (self._sums, self._at_sums))
        self._mixed = {"tests": self._tests, "leaves": leaves}
        self._levels = [
            [_level(stack, level) for stack in (self._sums, self._at_sums, self._weighted.flatten(2))]
            for level in range(one.depth + 1)
        ]
        self._weights, self._is_derived = new_stack(n, n_holes), new_stack(n, n_tests)
        self._shares: list[Tensor] = []
        self._shares_of: tuple[str, Tensor, Tensor] | None = None

    def forward(self, parameters: Stacks, X1: Tensor, beta: float, outputs: Tensor) -> None:
        self._take_shares(parameters["architecture"])
        torch.mul(parameters["tests"], self._is_derived.unsqueeze(2), out=self._tests)
        torch.mul(parameters["maps"], self._weights[..., None, None], out=self._weighted)
        (above, _, root), *below = self._levels
        above.copy_(root)
        for sums, _, weighted in below:
            torch.add(_pairs(weighted), above.unsqueeze(2), out=_pairs(sums))
            above = sums
        self._trees.forward(self._mixed, X1, beta, outputs)

    def backward(
        self, parameters: Stacks, X1: Tensor, beta: float, d_outputs: Tensor, gradients: Mapping[str, Tensor]
    ) -> None:
        of_trees = {"tests": gradients["tests"], "leaves": self._at_leaves}
        self._trees.backward(self._mixed, X1, beta, d_outputs, of_trees)
        for (_, at_above, _), (_, at_below, _) in reversed(list(pairwise(self._levels))):
            torch.sum(_pairs(at_below), 2, out=at_above)
        torch.mul(self._at_sums, self._weights.unsqueeze(2), out=gradients["maps"].flatten(2))
        gradients["tests"].mul_(self._is_derived.unsqueeze(2))
        if not self._shares[0].requires_grad:
            return
        at_weights = (self._at_sums * parameters["maps"].flatten(2)).sum(2)
        for module, shares, derivative, gradient in zip(
            self._modules, self._shares, at_weights, gradients["architecture"], strict=True
        ):
            with torch.enable_grad():
                (found,) = torch.autograd.grad(shares, module.architecture, derivative, retain_graph=True)
            gradient.copy_(found)

    def _take_shares(self, architecture: Tensor) -> None:
        """Bring the shares of the architecture up to date."""
        learns, structure = self._modules[0].learns, torch.stack([module.structure for module in self._modules])
        of = self._shares_of
        if of and learns == of[0] and structure.equal(of[1]) and architecture.equal(of[2]):
            return
        self._shares_of, self._shares = (learns, structure, architecture.clone()), []
        for module, weights, is_derived in zip(self._modules, self._weights, self._is_derived, strict=True):
            with torch.enable_grad():
                for_map, for_test = module.shares()
            self._shares.append(for_map)
            weights.copy_(for_map.detach())
            is_derived.copy_(for_test > 0)


def _level(holes: Tensor, level: int) -> Tensor:
    """Return the holes of a level of (R, n_holes, .)."""
    return holes[:, 2**level - 1 : 2 ** (level + 1) - 1]


def _pairs(children: Tensor) -> Tensor:
    """Return the children of a level (R, 2 n, .) as (R, n, 2, .): siblings next to each other."""
    return children.view(len(children), -1, 2, children.shape[2])


def _below(prefix: str, stacks: Stacks) -> dict[str, Tensor]:
    """Return the stacks whose names begin with a prefix, by what follows it."""
    return {name.removeprefix(prefix): stack for name, stack in stacks.items() if name.startswith(prefix)}


def _levels(nodes: Tensor, leaves: Tensor, *of_tests: Tensor) -> list[tuple[Tensor, ...]]:
    """Return for each level of tests, the root's first, the left children, the right ones, and the tests' own parts.

    Args:
        nodes, leaves: (R, n_tests, n) and (R, n_tests + 1, n), which have the children.
        of_tests: (R, n_tests, n) each.
    """
    depth = nodes.shape[1].bit_length()
    children = [_level(nodes, level) for level in range(1, depth)] + [leaves]
    return [
        (*_pairs(children[level]).unbind(2), *(_level(stack, level) for stack in of_tests)) for level in range(depth)
    ]
