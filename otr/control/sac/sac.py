"""Soft actor-critic for R independent runs at once, with Stable-Baselines3's semantics and hand-written gradients.

Run r owns row r of every stack (its critics the rows 2r and 2r + 1), its own temperature, discount and learning rate;
nothing is ever summed over runs, and a run's bits do not depend on the others (`stacked_tensors`). Haarnoja et al.
2018, with the automatic temperature, as `stable_baselines3.SAC`: losses are means over the batch, the temperature that
a step uses is the one before the step.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from otr.control.sac.actors import FleetActors, MlpActors
from otr.control.sac.adam import RunSettings, adam_groups
from otr.control.sac.mlp import Layers, StackedMlp, new_layers
from otr.control.sac.squashed_gaussian import ClippedActions, SquashedActions
from otr.control.sac.stacked_tensors import ROW_MULTIPLE, new_stack

N_CRITICS = 2


@dataclass(frozen=True)
class Shapes:
    """The settings that all runs of a fleet share."""

    n_inputs: int  # of the environment
    n_actions: int
    actor: tuple[int, ...]  # widths of the hidden layers
    critic: tuple[int, ...]
    batch_size: int  # transitions an update
    negative_slope: float = 0.0  # of the actor's and critics' activation
    tau: float = 0.005  # share of the online critics that goes into their targets at each update
    dense: bool = False  # whether the actor's layers after the first read the state, too
    clips: bool = False  # whether actions are clipped to [-1, 1], in place of tanh
    actor_delay: int = 1  # updates of the critics for each of actor and temperature


@dataclass
class Minibatch:
    """Transitions for one update: (R, B, .) each; `continues` is 0 where the successor is terminal, else 1."""

    states: Tensor
    actions: Tensor
    rewards: Tensor
    next_states: Tensor
    continues: Tensor


class FleetSac:
    """The learner of R runs: `act` and `update`. `load` restores what was learnt in `n_updates` before."""

    def __init__(
        self, shapes: Shapes, runs: Sequence[RunSettings], n_updates: int = 0, actor: FleetActors | None = None
    ) -> None:
        """Make the learner's memory; `actor` stands in for the layers that the shapes describe."""
        self.shapes, self.runs = shapes, tuple(runs)
        n, rows, n_actor_updates = len(runs), shapes.batch_size, n_updates // shapes.actor_delay
        critic_widths = (shapes.n_inputs + shapes.n_actions, *shapes.critic, 1)

        widths = (shapes.n_inputs, *shapes.actor, 2 * shapes.n_actions)
        slope, dense = shapes.negative_slope, shapes.dense
        self.actor: FleetActors = actor or MlpActors(
            runs, widths, rows, negative_slope=slope, dense=dense, n_updates=n_actor_updates
        )
        # Gradients and Adam's two moments have the layout of the parameters.
        self.critics, self.targets, self.critic_gradients, *self.critic_moments = (
            new_layers(N_CRITICS * n, critic_widths) for _ in range(5)
        )
        # A run's temperature, its gradient and its moments begin rows of their own, as its parameters do.
        temperature_rows = [torch.zeros(n, ROW_MULTIPLE) for _ in range(4)]
        self.log_temperature, self._temperature_gradient, *self.temperature_moments = (
            rows[:, 0] for rows in temperature_rows
        )
        self._temperature_rows = temperature_rows
        self._rate_share = 1.0
        critic_stacks = [self.critics, self.critic_gradients, *self.critic_moments]
        self._critic_adam = adam_groups(runs, [layers.flat for layers in critic_stacks], n_updates, n_each=N_CRITICS)
        self._temperature_adam = adam_groups(runs, temperature_rows, n_actor_updates, decays=False)

        self._critic_pass = StackedMlp(self.critics, rows, shapes.negative_slope)
        self._kind = ClippedActions if shapes.clips else SquashedActions
        self._actions = self._kind(n, 2 * rows, shapes.n_actions)
        self._acting: SquashedActions | None = None

        def column(values: Sequence[float]) -> Tensor:
            return torch.tensor(values).view(n, 1)

        self._gamma = column([run.gamma for run in runs])
        self.highest_value = column([math.inf for _ in runs])  # of what the critics learn towards
        self._automatic = torch.tensor([float(run.temperature is None) for run in runs])
        self._actor_inputs = new_stack(n, 2 * rows, shapes.n_inputs)
        self._critic_inputs = new_stack(N_CRITICS * n, rows, critic_widths[0])
        self._target_inputs = torch.zeros_like(self._critic_inputs)
        self._d_actor = new_stack(n, rows, 2 * shapes.n_actions)
        self._d_critics = new_stack(N_CRITICS * n, rows, 1)

    # -- parameters of one run ------------------------------------------------------------------------------------

    def tensors(self, run: int) -> dict[str, Tensor]:
        """Return views of everything that run `run` has learnt, by name; writing into them changes the run."""
        critics = slice(N_CRITICS * run, N_CRITICS * (run + 1))
        stacks = {
            "critics": self.critics,
            "critics.moment1": self.critic_moments[0],
            "critics.moment2": self.critic_moments[1],
            "targets": self.targets,
        }
        views = self.actor.tensors(run)
        views |= {f"{name}.{key}": view for name, each in stacks.items() for key, view in each.named(critics).items()}
        views["log_temperature"] = self.log_temperature[run : run + 1]
        for i, moment in enumerate(self.temperature_moments, start=1):
            views[f"log_temperature.moment{i}"] = moment[run : run + 1]
        return views

    def initialise(self, run: int, generator: torch.Generator) -> None:
        """Draw the run's actor and critics."""
        critics = slice(N_CRITICS * run, N_CRITICS * (run + 1))
        self.actor.initialise(run, generator)
        self.critics.initialise(critics, generator)
        temperature = self.runs[run].temperature
        self.log_temperature[run] = 0.0 if temperature is None else math.log(temperature)
        self.targets.flat[critics] = self.critics.flat[critics]

    def load(self, run: int, saved: dict[str, Tensor]) -> None:
        """Take over what a run had learnt, as `tensors` named it; to be called before the first update."""
        for name, tensor in self.tensors(run).items():
            tensor.copy_(saved[name])

    @property
    def n_updates(self) -> int:
        """Updates done, those of earlier learners included."""
        return int(self._critic_adam[0].steps[0])

    # -- acting ---------------------------------------------------------------------------------------------------

    def act(self, states: Tensor, noise: Tensor | None) -> Tensor:
        """Return actions in [-1, 1].

        Args:
            states: (R, E, n_inputs).
            noise: (R, E, n_actions), standard normal; None for the deterministic action.
        """
        n, n_envs, _ = states.shape
        if self._acting is None or self._acting.actions.shape[1] != n_envs:
            self._acting = self._kind(n, n_envs, self.shapes.n_actions)
        return self._acting.sample(self.actor.act(states), noise).clone()

    def answers(self, run: int, states: Tensor) -> Tensor:
        """Return one run's deterministic actions in [-1, 1], (n, n_actions), in states (n, n_inputs)."""
        return torch.tanh(self.actor.answers(run, states)[:, : self.shapes.n_actions])

    # -- learning -------------------------------------------------------------------------------------------------

    def at_step(self, n_steps: int, rate_share: float = 1.0) -> None:
        """Make ready for the updates after so many steps of the environment, at a share of the learning rates."""
        self._rate_share = rate_share * self.actor.at_step(n_steps)

    @torch.no_grad()
    def update(self, batch: Minibatch, noise: Tensor) -> None:
        """Do one gradient step of every run.

        Args:
            batch: the transitions.
            noise: (R, 2 B, n_actions), standard normal, for the actions in the states and, below, in their successors.
        """
        rows = self.shapes.batch_size
        self._actor_inputs[:, :rows] = batch.states
        self._actor_inputs[:, rows:] = batch.next_states
        answers = self.actor.forward(self._actor_inputs)
        actions = self._actions.sample(answers, noise)
        log_probability = self._actions.log_probability(answers, noise)
        temperature = self._temperature_rows[0].exp()[:, :1]
        self._update_critics(batch, actions[:, rows:], temperature * log_probability[:, rows:])
        if self.n_updates % self.shapes.actor_delay == 0:
            d_actions = self._d_actions(actions[:, :rows])
            self._actions.gradient(answers, noise, temperature, d_actions, self._d_actor)
            self.actor.backward(self._actor_inputs, self._d_actor)
            target_entropy = -float(self.shapes.n_actions)
            mean_log_probability = log_probability[:, :rows].mean(1)
            torch.mul(mean_log_probability + target_entropy, -self._automatic, out=self._temperature_gradient)
            self.actor.step(self._rate_share)
            for group in self._temperature_adam:
                group.step(self._rate_share)
        self.targets.flat.lerp_(self.critics.flat, self.shapes.tau)

    def _update_critics(self, batch: Minibatch, next_actions: Tensor, costs: Tensor) -> None:
        """Step the critics towards the targets' least value of the next actions, less their entropy's costs (R, B)."""
        n, rows, d = len(self.runs), self.shapes.batch_size, self.shapes.n_inputs
        target_inputs, critic_inputs, d_critics = (
            stack.view(n, N_CRITICS, rows, -1) for stack in (self._target_inputs, self._critic_inputs, self._d_critics)
        )
        target_inputs[..., :d] = batch.next_states.unsqueeze(1)
        target_inputs[..., d:] = next_actions.unsqueeze(1)
        values = self._values(self.targets, self._target_inputs).amin(1) - costs
        goal = torch.minimum(batch.rewards + batch.continues * self._gamma * values, self.highest_value)
        critic_inputs[..., :d] = batch.states.unsqueeze(1)
        critic_inputs[..., d:] = batch.actions.unsqueeze(1)
        torch.sub(self._values(self.critics, self._critic_inputs), goal.unsqueeze(1), out=d_critics[..., 0])
        self._d_critics.div_(rows)
        self._critic_pass.backward(self.critics, self._critic_inputs, self._d_critics, self.critic_gradients)
        for group in self._critic_adam:
            group.step(self._rate_share)

    def _d_actions(self, actions: Tensor) -> Tensor:
        """Return the derivative of the actor's loss by its actions (R, B, n_actions), through the critics' values.

        The states are those of the critics' last update.
        """
        n, rows, d = len(self.runs), self.shapes.batch_size, self.shapes.n_inputs
        self._critic_inputs.view(n, N_CRITICS, rows, -1)[..., d:] = actions.unsqueeze(1)
        values, d_critics = self._values(self.critics, self._critic_inputs), self._d_critics.view(n, N_CRITICS, rows)
        torch.mul(values[:, 0] <= values[:, 1], -1 / rows, out=d_critics[:, 0])
        torch.sub(-1 / rows, d_critics[:, 0], out=d_critics[:, 1])
        d_actions = self._critic_pass.backward(self.critics, self._critic_inputs, self._d_critics, None, d)
        assert d_actions is not None
        return d_actions.view(n, N_CRITICS, rows, -1).sum(1)

    def _values(self, layers: Layers, inputs: Tensor) -> Tensor:
        """Return the critics' values, (R, 2, B)."""
        return self._critic_pass.forward(layers, inputs).view(len(self.runs), N_CRITICS, -1)
