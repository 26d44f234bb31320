"""The actors of R runs of the soft actor-critic: stacked networks, or soft trees.

Both give means and log standard deviations, (R, n_rows, 2 n_actions), and learn from the loss's derivative by these.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from pipelines.config.methods import SoftConfig
from pipelines.training.fleet.adam import BETA1, BETA2, EPSILON, RunSettings, adam_groups
from pipelines.training.fleet.mlp import Layers, StackedMlp, new_layers
from pipelines.training.fleet.stacked_tensors import new_stack
from pipelines.training.soft_trees import Shape, SoftModule, build_module, rate_share, set_phase


class FleetActors(Protocol):
    """What the learner asks of its actors; inputs are stacks of `new_stack`."""

    def at_step(self, n_steps: int) -> float:
        """Make ready for the updates after so many steps; return the share of the learning rate at which they go."""
        ...

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


class MlpActors:
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

    def at_step(self, n_steps: int) -> float:
        """Return 1: the learning rate stays."""
        return 1.0

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


@dataclass(frozen=True)
class SoftTraining:
    """What soft trees are trained as: their shape, and what changes in the course of `n_steps`."""

    shape: Shape
    method: SoftConfig
    n_steps: int


class SoftActors:
    """Soft trees that give the means, beside log standard deviations linear in the state; one by one, by autograd.

    As under Stable-Baselines3 (`pipelines/training/soft_actor.py`), what gets no gradient is not moved.
    """

    def __init__(
        self, runs: Sequence[RunSettings], training: SoftTraining, n_inputs: int, n_actions: int, batch_size: int
    ) -> None:
        self._training = training
        self.trees: list[SoftModule] = [build_module(training.shape, n_inputs, n_actions) for _ in runs]
        self._log_stds = [nn.Linear(n_inputs, n_actions) for _ in runs]
        self._optimizers = [
            _adam(nn.ModuleList(parts), run) for *parts, run in zip(self.trees, self._log_stds, runs, strict=True)
        ]
        self._answers = new_stack(len(runs), 2 * batch_size, 2 * n_actions)
        self._graphs: list[Tensor] = []

    def at_step(self, n_steps: int) -> float:
        """Make the tests as hard as they are to be, and choose what learns."""
        method, of_steps = self._training.method, self._training.n_steps
        for tree in self.trees:
            set_phase(tree, method, n_steps, of_steps)
        return rate_share(method, n_steps, of_steps)

    def forward(self, inputs: Tensor) -> Tensor:
        with torch.enable_grad():
            self._graphs = [self._of(run, states) for run, states in enumerate(inputs)]
        for answers, graph in zip(self._answers, self._graphs, strict=True):
            answers.copy_(graph.detach())
        return self._answers

    def backward(self, inputs: Tensor, d_answers: Tensor) -> None:
        for graph, derivative, optimizer in zip(self._graphs, d_answers, self._optimizers, strict=True):
            optimizer.zero_grad()
            with torch.enable_grad():
                of_states = graph[: len(derivative)]
            of_states.backward(derivative)  # type: ignore[no-untyped-call]

    def step(self, rate_share: float) -> None:
        for optimizer in self._optimizers:
            (group,) = optimizer.param_groups
            group["lr"] = optimizer.defaults["lr"] * rate_share
            optimizer.step()

    def act(self, states: Tensor) -> Tensor:
        with torch.no_grad():  # of copies: rounding may depend on where factors begin (`stacked_tensors`)
            return torch.stack([self._of(run, own.clone()) for run, own in enumerate(states)])

    def answers(self, run: int, states: Tensor) -> Tensor:
        with torch.no_grad():
            return self._of(run, states)

    def tensors(self, run: int) -> dict[str, Tensor]:
        parts = nn.ModuleDict({"mean": self.trees[run], "log_std": self._log_stds[run]})
        views = {f"actor.{name}": tensor for name, tensor in parts.state_dict().items()}
        for name, parameter in parts.named_parameters():
            state = self._optimizers[run].state[parameter]
            views |= {f"actor.{name}.{key}": tensor for key, tensor in state.items()}
        return views

    def initialise(self, run: int, generator: torch.Generator) -> None:
        """Draw a tree as its class does, and the deviations' maps as torch's Linear does."""
        shape, tree = self._training.shape, self.trees[run]
        fresh = build_module(shape, tree.n_inputs, tree.n_outputs, generator)
        tree.load_state_dict(fresh.state_dict())
        limit = 1 / math.sqrt(tree.n_inputs)
        with torch.no_grad():
            for parameter in self._log_stds[run].parameters():
                parameter.uniform_(-limit, limit, generator=generator)

    def _of(self, run: int, states: Tensor) -> Tensor:
        return torch.cat((self.trees[run](states), self._log_stds[run](states)), dim=1)


def _adam(parts: nn.Module, run: RunSettings) -> torch.optim.Adam:
    """Return Adam with its state made, so that a checkpoint can be written into it."""
    adam = torch.optim.Adam(
        parts.parameters(), lr=run.learning_rate, betas=(BETA1, BETA2), eps=EPSILON, weight_decay=run.weight_decay
    )
    for parameter in parts.parameters():
        adam.state[parameter] = {
            "step": torch.zeros(()),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return adam
