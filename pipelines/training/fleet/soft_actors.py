"""Stacked soft trees as the actors of R runs of the soft actor-critic."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from otr.control.sac.actors import Learning
from otr.control.sac.adam import RunSettings
from otr.control.sac.stacked_tensors import multiply, new_stack
from pipelines.config.hardened_methods import SoftConfig
from pipelines.training.fleet.stacked_soft_trees import StackedTrees, stacked_trees
from pipelines.training.soft_trees import Shape, SoftModule, build_module, rate_share, set_phase


@dataclass(frozen=True)
class SoftTraining:
    """What soft trees are trained as: their shape, and what changes in the course of `n_steps`."""

    shape: Shape
    method: SoftConfig
    n_steps: int


class SoftActors:
    """Soft trees that give the means, and log standard deviations linear in the state: stacked, gradients by hand.

    As under Stable-Baselines3 (`pipelines/training/sb3/soft_actor.py`), what gets no gradient is not moved: pi-PRL's
    program and its architecture, which learn in turns, have an optimiser each.

    Attributes:
        trees: the modules, whose parameters are in the stacks.
    """

    def __init__(
        self, runs: Sequence[RunSettings], training: SoftTraining, n_inputs: int, n_actions: int, batch_size: int
    ) -> None:
        self._training = training
        self.trees: list[SoftModule] = [build_module(training.shape, n_inputs, n_actions) for _ in runs]
        shapes = {name: tuple(parameter.shape) for name, parameter in self.trees[0].named_parameters()}
        of_architecture = {name: shapes.pop(name) for name in ("architecture",) if name in shapes}
        self._program, self._architecture = Learning.of(runs, shapes), Learning.of(runs, of_architecture)
        self._log_std = Learning.of(runs, {"weight": (n_actions, n_inputs), "bias": (n_actions,)})
        self._parameters = self._program.parameters | self._architecture.parameters
        self._gradients = self._program.gradients | self._architecture.gradients
        for run, tree in enumerate(self.trees):
            for name, parameter in tree.named_parameters():
                parameter.data = self._parameters[name][run]
        self._updating = self._pass(2 * batch_size, batch_size)
        self._acting: _SoftPass | None = None

    def at_step(self, n_steps: int) -> float:
        """Set how hard the tests are, and choose what learns."""
        method, of_steps = self._training.method, self._training.n_steps
        for tree in self.trees:
            set_phase(tree, method, n_steps, of_steps)
        return rate_share(method, n_steps, of_steps)

    def forward(self, inputs: Tensor) -> Tensor:
        return self._answer(self._updating, inputs)

    def backward(self, inputs: Tensor, d_answers: Tensor) -> None:
        d_means, d_log_stds = d_answers.chunk(2, dim=2)
        X1, of_log_std = self._updating.X1, self._log_std.gradients
        self._updating.trees.backward(self._parameters, X1, self._hardness, d_means, self._gradients)
        multiply(d_log_stds.transpose(1, 2), X1[:, : d_answers.shape[1], :-1], of_log_std["weight"])
        torch.sum(d_log_stds, 1, out=of_log_std["bias"])

    def step(self, rate_share: float) -> None:
        is_architectures = getattr(self.trees[0], "learns", "program") == "architecture"
        for learning in (self._architecture if is_architectures else self._program, self._log_std):
            for group in learning.groups:
                group.step(rate_share)

    def act(self, states: Tensor) -> Tensor:
        n_envs = states.shape[1]
        if self._acting is None or self._acting.X1.shape[1] != n_envs:
            self._acting = self._pass(n_envs, n_envs)
        return self._answer(self._acting, states)

    @torch.no_grad()
    def answers(self, run: int, states: Tensor) -> Tensor:
        weight, bias = (self._log_std.parameters[name][run] for name in ("weight", "bias"))
        return torch.cat((self.trees[run](states), nn.functional.linear(states, weight, bias)), dim=1)

    def tensors(self, run: int) -> dict[str, Tensor]:
        parts = {"mean": (self._program, self._architecture), "log_std": (self._log_std,)}
        views = {f"actor.mean.{name}": buffer for name, buffer in self.trees[run].named_buffers()}
        for part, learnt in parts.items():
            for learning in learnt:
                views |= {f"actor.{part}.{name}": view for name, view in learning.tensors(run).items()}
        return views

    def initialise(self, run: int, generator: torch.Generator) -> None:
        """Draw a tree as its class does, and the deviations' maps as torch's Linear does."""
        shape, tree = self._training.shape, self.trees[run]
        fresh = build_module(shape, tree.n_inputs, tree.n_outputs, generator)
        tree.load_state_dict(fresh.state_dict())
        limit = 1 / math.sqrt(tree.n_inputs)
        for stack in self._log_std.parameters.values():
            stack[run].uniform_(-limit, limit, generator=generator)

    @property
    def _hardness(self) -> float:
        """How hard the tests of all trees are."""
        return float(next(buffer for name, buffer in self.trees[0].named_buffers() if name.endswith("beta")))

    def _pass(self, n_rows: int, n_back_rows: int) -> "_SoftPass":
        n, tree = len(self.trees), self.trees[0]
        X1 = new_stack(n, n_rows, tree.n_inputs + 1)
        X1[..., -1] = 1.0
        answers = new_stack(n, n_rows, 2 * tree.n_outputs)
        return _SoftPass(stacked_trees(self.trees, n_rows, n_back_rows), X1, answers)

    def _answer(self, workspace: "_SoftPass", states: Tensor) -> Tensor:
        X1, answers = workspace.X1, workspace.answers
        X1[..., :-1] = states
        means, log_stds = answers.chunk(2, dim=2)
        workspace.trees.forward(self._parameters, X1, self._hardness, means)
        weight, bias = self._log_std.parameters["weight"], self._log_std.parameters["bias"]
        multiply(X1[..., :-1], weight.transpose(1, 2), log_stds).add_(bias.unsqueeze(1))
        return answers


@dataclass(frozen=True)
class _SoftPass:
    """The workspace of a pass: states with a column of ones, and what is made of them."""

    trees: StackedTrees
    X1: Tensor  # (R, n_rows, d + 1)
    answers: Tensor  # (R, n_rows, 2 n_actions)
