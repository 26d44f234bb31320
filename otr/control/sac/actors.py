"""Actors of R runs: what they are to the learner, stacked networks with gradients by hand, and any modules of torch.

Each run's module computes alone, on parameters in stacks of `stacked_tensors`: its bits do not depend on the others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from otr.control.sac.adam import AdamGroup, RunSettings, adam_groups
from otr.control.sac.mlp import Layers, StackedMlp, new_layers
from otr.control.sac.stacked_tensors import new_flat, new_stack


class FleetActors(Protocol):
    """The interface of the actors of R runs for the learner; inputs are stacks of `new_stack`.

    Answers are means and log standard deviations, (R, n_rows, 2 n_actions).
    """

    def at_step(self, n_steps: int) -> float:
        """Make ready for the updates after so many steps; return the share of the learning rate that they use."""
        return 1.0

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the answers to an update's states and, below them, their successors (R, 2 B, d), until the next."""
        ...

    def backward(self, inputs: Tensor, d_answers: Tensor) -> None:
        """Take the gradients of the last `forward`, by the derivative (R, B, 2 n_actions) by the states' answers."""
        ...

    def step(self, rate_share: float) -> None:
        """Do Adam's step by the last gradients."""
        ...

    def act(self, states: Tensor) -> Tensor:
        """Return the answers to the states (R, E, d) of the runs' environments."""
        ...

    def answers(self, run: int, states: Tensor) -> Tensor:
        """Return one run's answers, (n, 2 n_actions), to states (n, d)."""
        ...

    def tensors(self, run: int) -> dict[str, Tensor]:
        """Return views of everything that a run's actor has learnt, by name; writing into them changes it."""
        ...

    def initialise(self, run: int, generator: torch.Generator) -> None:
        """Draw a run's actor."""
        ...


class MlpActors(FleetActors):
    """(Leaky) ReLU networks: stacked, with gradients by hand."""

    def __init__(
        self,
        runs: Sequence[RunSettings],
        widths: Sequence[int],
        batch_size: int,
        *,
        negative_slope: float,
        dense: bool,
        n_updates: int,
    ) -> None:
        self._slope, self._dense = negative_slope, dense
        # Gradients and Adam's two moments have the layout of the parameters.
        stacks = [new_layers(len(runs), widths, dense=dense) for _ in range(4)]
        self.layers, self.gradients, *self.moments = stacks
        self._pass = StackedMlp(self.layers, 2 * batch_size, negative_slope, batch_size, dense)
        self._acting: tuple[StackedMlp, Tensor] | None = None
        self._groups = adam_groups(runs, [layers.flat for layers in stacks], n_updates)

    def forward(self, inputs: Tensor) -> Tensor:
        return self._pass.forward(self.layers, inputs)

    def backward(self, inputs: Tensor, d_answers: Tensor) -> None:
        self._pass.backward(self.layers, inputs, d_answers, self.gradients)

    def step(self, rate_share: float) -> None:
        for group in self._groups:
            group.step(rate_share)

    def act(self, states: Tensor) -> Tensor:
        n_runs, n_envs, n_inputs = states.shape
        if self._acting is None or self._acting[0].n_rows != n_envs:
            self._acting = self._network(self.layers, n_envs), new_stack(n_runs, n_envs, n_inputs)
        network, inputs = self._acting
        return network.forward(self.layers, inputs.copy_(states))

    def answers(self, run: int, states: Tensor) -> Tensor:
        one = self.layers.only(run)
        inputs = new_stack(1, *states.shape).copy_(states)
        return self._network(one, len(states)).forward(one, inputs)[0]

    def tensors(self, run: int) -> dict[str, Tensor]:
        one = slice(run, run + 1)
        stacks: dict[str, Layers] = {"actor": self.layers}
        stacks |= {f"actor.moment{i}": moment for i, moment in enumerate(self.moments, start=1)}
        return {f"{name}.{key}": view for name, layers in stacks.items() for key, view in layers.named(one).items()}

    def initialise(self, run: int, generator: torch.Generator) -> None:
        """Draw a network as torch's Linear does."""
        self.layers.initialise(slice(run, run + 1), generator)

    def _network(self, layers: Layers, n_rows: int) -> StackedMlp:
        return StackedMlp(layers, n_rows, self._slope, dense=self._dense)


class ModuleActors(FleetActors):
    """Modules of one shape, a run each, from states (n, d) to means and log standard deviations (n, 2 n_actions).

    A module that has a `penalty`, a number () that its last call left, adds it to its actor's loss. Of an update that
    is a call on the states and their successors together.

    Attributes:
        modules: with the parameters that they are given with; these move into the stacks.
    """

    def __init__(self, runs: Sequence[RunSettings], modules: Sequence[nn.Module]) -> None:
        self.modules = list(modules)
        shapes = {name: tuple(parameter.shape) for name, parameter in modules[0].named_parameters()}
        self._learning = Learning.of(runs, shapes)
        for run, module in enumerate(modules):
            for name, parameter in module.named_parameters():
                place = self._learning.parameters[name][run]
                parameter.data = place.copy_(parameter.data)
                parameter.grad = self._learning.gradients[name][run]
        self._answers: list[Tensor] = []
        self._penalties: list[Tensor] = []

    def forward(self, inputs: Tensor) -> Tensor:
        with torch.enable_grad():
            self._answers = [module(states) for module, states in zip(self.modules, inputs, strict=True)]
        penalties = [getattr(module, "penalty", None) for module in self.modules]
        self._penalties = [penalty for penalty in penalties if penalty is not None]
        return self._stacked(self._answers)

    def backward(self, inputs: Tensor, d_answers: Tensor) -> None:
        self._learning.zero_gradients()
        with torch.enable_grad():  # in which the first answers are a function of all
            learnt = [answers[: d_answers.shape[1]] for answers in self._answers]
        of_answers: list[Tensor | None] = [*d_answers.unbind()]
        torch.autograd.backward([*learnt, *self._penalties], of_answers + [None] * len(self._penalties))

    def step(self, rate_share: float) -> None:
        for group in self._learning.groups:
            group.step(rate_share)

    @torch.no_grad()
    def act(self, states: Tensor) -> Tensor:
        inputs = new_stack(*states.shape).copy_(states)  # each run's begin as in a run alone
        return self._stacked([module(own) for module, own in zip(self.modules, inputs, strict=True)])

    @torch.no_grad()
    def answers(self, run: int, states: Tensor) -> Tensor:
        answers: Tensor = self.modules[run](states)
        return answers

    def tensors(self, run: int) -> dict[str, Tensor]:
        views = {f"actor.{name}": buffer for name, buffer in self.modules[run].named_buffers()}
        return views | {f"actor.{name}": view for name, view in self._learning.tensors(run).items()}

    def initialise(self, run: int, generator: torch.Generator) -> None:
        """Leave the parameters that the module came with."""

    @staticmethod
    def _stacked(answers: Sequence[Tensor]) -> Tensor:
        """Return answers in a stack, in which elementwise functions give each run the bits that it has alone."""
        stack = new_stack(len(answers), *answers[0].shape)
        for place, own in zip(stack, answers, strict=True):
            place.copy_(own.detach())
        return stack


@dataclass(frozen=True)
class Learning:
    """Parameters of all runs that learn at the same time: stacks by name, and their optimisers."""

    parameters: dict[str, Tensor]
    gradients: dict[str, Tensor]
    moments: dict[str, dict[str, Tensor]]  # Adam's, by torch's names for them
    groups: list[AdamGroup]  # one, or one a run

    @classmethod
    def of(cls, runs: Sequence[RunSettings], shapes: Mapping[str, tuple[int, ...]]) -> "Learning":
        """Return zeros of these shapes a run."""
        flats, stacks = zip(*(new_flat(len(runs), list(shapes.values())) for _ in range(4)), strict=True)
        parameters, gradients, first, second = (dict(zip(shapes, each, strict=True)) for each in stacks)
        groups = adam_groups(runs, flats, 0) if shapes else []
        return cls(parameters, gradients, {"exp_avg": first, "exp_avg_sq": second}, groups)

    def zero_gradients(self) -> None:
        """Make all gradients zero."""
        for group in self.groups:
            group.tensors[1][0].zero_()

    def tensors(self, run: int) -> dict[str, Tensor]:
        """Return views of a run's parameters and of Adam's state, by torch's names."""
        views = {name: stack[run] for name, stack in self.parameters.items()}
        for name in self.parameters:
            views[f"{name}.step"] = self.groups[run if len(self.groups) > 1 else 0].steps[0]
            views |= {f"{name}.{moment}": stacks[name][run] for moment, stacks in self.moments.items()}
        return views
