"""Soft actor-critic for R independent runs at once, with Stable-Baselines3's semantics and hand-written gradients.

Run r owns row r of every stack (its critics the rows 2r and 2r + 1), its own temperature, discount and learning rate;
nothing is ever summed over runs. Haarnoja et al. 2018, with the automatic temperature, as `stable_baselines3.SAC`:
log-probabilities are corrected for tanh by log(1 - tanh(u)^2 + 1e-6), log standard deviations are clipped to [-20, 2],
losses are means over the batch, the temperature that a step uses is the one before the step.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.fleet.adam import AdamGroup, stack_tensors
from pipelines.fleet.mlp import Layers, StackedMlp, new_layers

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
SQUASH_EPSILON = 1e-6
HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
N_CRITICS = 2


@dataclass(frozen=True)
class Shapes:
    """What all runs of a fleet have in common.

    Attributes:
        n_inputs, n_actions: of the environment.
        actor, critic: widths of the hidden layers.
        batch_size: transitions an update.
        negative_slope: of the actor's and critics' activation.
        tau: share of the online critics that goes into their targets at each update.
        precision: fp32 or bf16 (see `pipelines/fleet/mlp.py`).
    """

    n_inputs: int
    n_actions: int
    actor: tuple[int, ...]
    critic: tuple[int, ...]
    batch_size: int
    negative_slope: float = 0.0
    tau: float = 0.005
    precision: str = "fp32"


@dataclass(frozen=True)
class RunSettings:
    """What runs of a fleet may differ in. `temperature` None is the automatic one, a number keeps it fixed."""

    learning_rate: float
    gamma: float
    weight_decay: float = 0.0
    temperature: float | None = None


@dataclass
class Minibatch:
    """Transitions for one update: (R, B, .) each; `continues` is 0 where the successor is terminal, else 1."""

    states: Tensor
    actions: Tensor
    rewards: Tensor
    next_states: Tensor
    continues: Tensor


class FleetSac:
    """The learner of R runs: `act` and `update`.

    Args:
        shapes: common to all runs.
        runs: one row each.
        device: where everything lies.
        n_updates: done before, by what `load` will bring.
    """

    def __init__(self, shapes: Shapes, runs: Sequence[RunSettings], device: torch.device, n_updates: int = 0) -> None:
        self.shapes, self.runs, self.device = shapes, tuple(runs), device
        n, rows = len(runs), shapes.batch_size
        actor_widths = (shapes.n_inputs, *shapes.actor, 2 * shapes.n_actions)  # means, then log standard deviations
        critic_widths = (shapes.n_inputs + shapes.n_actions, *shapes.critic, 1)

        def stack(n_networks: int, widths: Sequence[int], precision: str = "fp32") -> Layers:
            return new_layers(n_networks, widths, device, precision)

        self.actor = stack(n, actor_widths)
        self.critics = stack(N_CRITICS * n, critic_widths, shapes.precision)
        self.targets = stack(N_CRITICS * n, critic_widths, shapes.precision)
        self.log_temperature = torch.zeros(n, device=device)
        # Gradients and Adam's two moments have the layout of the parameters.
        self.actor_gradients, *self.actor_moments = (stack(n, actor_widths) for _ in range(3))
        self.critic_gradients, *self.critic_moments = (stack(N_CRITICS * n, critic_widths) for _ in range(3))
        self.temperature_moments = [torch.zeros(n, device=device) for _ in range(2)]
        self._n_updates_before = n_updates
        self._temperature_gradient = torch.zeros(n, device=device)
        self._groups: tuple[list[AdamGroup], list[AdamGroup]] | None = None

        self._actor_pass = StackedMlp(self.actor, 2 * rows, shapes.negative_slope, n_back_rows=rows)
        self._critic_pass = StackedMlp(self.critics, rows, shapes.negative_slope)
        self._acting_pass: StackedMlp | None = None

        def column(values: Sequence[float]) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device).view(n, 1)

        self._gamma = column([run.gamma for run in runs])
        self._automatic = torch.tensor([float(run.temperature is None) for run in runs], device=device)
        self._actor_inputs = torch.empty(n, 2 * rows, shapes.n_inputs, device=device)
        self._critic_inputs = torch.empty(n, N_CRITICS, rows, critic_widths[0], device=device)
        self._target_inputs = torch.empty_like(self._critic_inputs)
        self._d_actor = torch.zeros(n, rows, 2 * shapes.n_actions, device=device)
        self._d_critics = torch.empty(n, N_CRITICS, rows, device=device)

    # -- parameters of one run ------------------------------------------------------------------------------------

    def tensors(self, run: int) -> dict[str, Tensor]:
        """Return views of everything that run `run` has learnt, by name; writing into them changes the run."""
        critics = slice(N_CRITICS * run, N_CRITICS * (run + 1))
        stacks = {
            "actor": (self.actor, slice(run, run + 1)),
            "actor.moment1": (self.actor_moments[0], slice(run, run + 1)),
            "actor.moment2": (self.actor_moments[1], slice(run, run + 1)),
            "critics": (self.critics, critics),
            "critics.moment1": (self.critic_moments[0], critics),
            "critics.moment2": (self.critic_moments[1], critics),
            "targets": (self.targets, critics),
        }
        views = {
            f"{name}.{kind}{layer}": tensor[rows]
            for name, (stacked, rows) in stacks.items()
            for kind, tensors in (("weight", stacked.weights), ("bias", stacked.biases))
            for layer, tensor in enumerate(tensors)
        }
        views["log_temperature"] = self.log_temperature[run : run + 1]
        for i, moment in enumerate(self.temperature_moments, start=1):
            views[f"log_temperature.moment{i}"] = moment[run : run + 1]
        return views

    def initialise(self, run: int, generator: torch.Generator) -> None:
        """Draw the run's networks as torch's Linear does, from a generator of the CPU."""
        tensors = self.tensors(run)
        for name in ("actor", "critics"):
            layers = self.actor if name == "actor" else self.critics
            for layer, weight in enumerate(layers.weights):
                limit = 1 / math.sqrt(weight.shape[1])
                for kind in ("weight", "bias"):
                    view = tensors[f"{name}.{kind}{layer}"]
                    view.copy_((2 * torch.rand(view.shape, generator=generator) - 1) * limit)
        temperature = self.runs[run].temperature
        self.log_temperature[run] = 0.0 if temperature is None else math.log(temperature)
        for layer in range(len(self.critics.weights)):
            for kind in ("weight", "bias"):
                tensors[f"targets.{kind}{layer}"].copy_(tensors[f"critics.{kind}{layer}"])
        self.refresh()

    def load(self, run: int, saved: dict[str, Tensor]) -> None:
        """Take over what a run had learnt, as `tensors` named it; to be called before the first update."""
        for name, tensor in self.tensors(run).items():
            tensor.copy_(saved[name])
        self.refresh()

    @property
    def n_updates(self) -> int:
        """Updates done, those of earlier learners included."""
        return self._n_updates_before if self._groups is None else int(self._groups[0][0].steps[0])

    def refresh(self) -> None:
        """Take over parameters that were written from outside."""
        for layers in (self.critics, self.targets):
            layers.refresh()

    def is_finite(self) -> list[bool]:
        """Return for each run whether all its parameters are finite numbers."""
        n = len(self.runs)
        finite = torch.isfinite(self.log_temperature)
        for layers in (self.actor, self.critics, self.targets):
            for tensor in (*layers.weights, *layers.biases):
                finite = finite & torch.isfinite(tensor).reshape(n, -1).all(1)
        return [bool(value) for value in finite.tolist()]

    # -- acting ---------------------------------------------------------------------------------------------------

    def act(self, states: Tensor, noise: Tensor | None) -> Tensor:
        """Return actions in [-1, 1].

        Args:
            states: (R, E, n_inputs).
            noise: (R, E, n_actions), standard normal; None for the deterministic action.
        """
        if self._acting_pass is None or self._acting_pass.n_rows != states.shape[1]:
            self._acting_pass = StackedMlp(self.actor, states.shape[1], self.shapes.negative_slope)
        mean, log_std = self._acting_pass.forward(self.actor, states).chunk(2, dim=2)
        if noise is None:
            return torch.tanh(mean)
        return torch.tanh(mean + log_std.clamp(LOG_STD_MIN, LOG_STD_MAX).exp() * noise)

    def answers(self, run: int, states: Tensor) -> Tensor:
        """Return one run's deterministic actions in [-1, 1], (n, n_actions), in states (n, n_inputs)."""
        actor = self.actor.only(run)
        outputs = StackedMlp(actor, len(states), self.shapes.negative_slope).forward(actor, states.unsqueeze(0))
        return torch.tanh(outputs[0, :, : self.shapes.n_actions])

    # -- learning -------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def update(self, batch: Minibatch, noise: Tensor) -> None:
        """Do one gradient step of every run.

        Args:
            batch: the transitions.
            noise: (R, 2 B, n_actions), standard normal, for the actions in the states and, below, in their successors.
        """
        shapes, n, rows = self.shapes, len(self.runs), self.shapes.batch_size
        d = shapes.n_inputs
        self._actor_inputs[:, :rows] = batch.states
        self._actor_inputs[:, rows:] = batch.next_states
        answers = self._actor_pass.forward(self.actor, self._actor_inputs)
        raw_log_std = answers[:, :, shapes.n_actions :]
        std = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX).exp_()
        squashed = torch.addcmul(answers[:, :, : shapes.n_actions], std, noise).tanh_()
        slope = 1 - squashed * squashed  # of tanh
        log_probability = self._log_probability(raw_log_std, noise, slope)
        temperature = self.log_temperature.exp().view(n, 1)

        # Critics, against the targets' least value of the next state.
        self._target_inputs[..., :d] = batch.next_states.unsqueeze(1)
        self._target_inputs[..., d:] = squashed[:, rows:].unsqueeze(1)
        values = self._values(self.targets, self._target_inputs).amin(1) - temperature * log_probability[:, rows:]
        goal = batch.rewards + batch.continues * self._gamma * values
        self._critic_inputs[..., :d] = batch.states.unsqueeze(1)
        self._critic_inputs[..., d:] = batch.actions.unsqueeze(1)
        torch.sub(self._values(self.critics, self._critic_inputs), goal.unsqueeze(1), out=self._d_critics)
        self._d_critics.div_(rows)
        self._back(self._critic_inputs, self.critic_gradients, None)
        critic_adam, actor_adam = self._adam()
        for group in critic_adam:
            group.step()
        self.critics.refresh()

        # Actor and temperature, against the critics just updated.
        self._critic_inputs[..., d:] = squashed[:, :rows].unsqueeze(1)
        first, second = self._values(self.critics, self._critic_inputs).unbind(1)
        least_is_first = (first <= second).to(torch.float32)
        torch.mul(least_is_first, -1 / rows, out=self._d_critics[:, 0])
        torch.sub(-1 / rows, self._d_critics[:, 0], out=self._d_critics[:, 1])
        d_squashed = self._back(self._critic_inputs, None, d)
        assert d_squashed is not None
        self._actor_gradient(d_squashed, squashed, slope, std, noise, temperature)
        self._actor_pass.backward(self.actor, self._actor_inputs, self._d_actor, self.actor_gradients)
        target_entropy = -float(shapes.n_actions)
        mean_log_probability = log_probability[:, :rows].mean(1)
        torch.mul(mean_log_probability + target_entropy, -self._automatic, out=self._temperature_gradient)
        for group in actor_adam:
            group.step()
        self.targets.flat.lerp_(self.critics.flat, shapes.tau)
        self.targets.refresh()

    def _adam(self) -> tuple[list[AdamGroup], list[AdamGroup]]:
        """Return Adam's groups of the critics, and those of actors and temperatures, made at the first update.

        Runs that share learning rate and weight decay share a group of whole flat vectors.
        """
        if self._groups is None:
            alike = len({(run.learning_rate, run.weight_decay) for run in self.runs}) == 1
            critics = [self.critics, self.critic_gradients, *self.critic_moments]
            actors = [self.actor, self.actor_gradients, *self.actor_moments]
            temperatures = [self.log_temperature, self._temperature_gradient, *self.temperature_moments]
            self._groups = [], []
            for run, settings in enumerate(self.runs[:1] if alike else self.runs):
                one = slice(None) if alike else slice(run, run + 1)
                two = slice(None) if alike else slice(N_CRITICS * run, N_CRITICS * (run + 1))
                rate, decay, n_updates = settings.learning_rate, settings.weight_decay, self._n_updates_before
                of_critics = [stack_tensors(layers, two) for layers in critics]
                of_actors = [stack_tensors(layers, one) for layers in actors]
                of_temperatures = [[vector[one]] for vector in temperatures]
                self._groups[0].append(AdamGroup.of(rate, decay, of_critics, n_updates))
                self._groups[1].append(AdamGroup.of(rate, decay, of_actors, n_updates))
                self._groups[1].append(AdamGroup.of(rate, 0.0, of_temperatures, n_updates))
        return self._groups

    def _log_probability(self, raw_log_std: Tensor, noise: Tensor, slope: Tensor) -> Tensor:
        """Return log pi of the squashed actions, (R, 2 B)."""
        terms = noise * noise * -0.5
        terms -= raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        terms -= (slope + SQUASH_EPSILON).log_()
        return terms.sum(2).sub_(self.shapes.n_actions * HALF_LOG_2PI)

    def _actor_gradient(
        self, d_squashed: Tensor, squashed: Tensor, slope: Tensor, std: Tensor, noise: Tensor, temperature: Tensor
    ) -> None:
        """Write the actor's loss's derivative by its answers in the states.

        The loss is mean(temperature * log pi - least value); d_squashed is the derivative of its second term.
        """
        rows, n_actions = self.shapes.batch_size, self.shapes.n_actions
        squashed, slope, std, noise = (tensor[:, :rows] for tensor in (squashed, slope, std, noise))
        share = (temperature / rows).unsqueeze(2)  # of one transition's entropy in the mean
        d_mean = self._d_actor[:, :, :n_actions]
        torch.mul(squashed / (slope + SQUASH_EPSILON), 2 * share, out=d_mean)
        d_mean += d_squashed
        d_mean *= slope
        d_log_std = self._d_actor[:, :, n_actions:]
        torch.mul(d_mean, std * noise, out=d_log_std)
        d_log_std -= share
        raw = self._actor_pass.outputs[:, :rows, n_actions:]
        d_log_std *= (raw >= LOG_STD_MIN) & (raw <= LOG_STD_MAX)

    def _values(self, layers: Layers, inputs: Tensor) -> Tensor:
        """Return the critics' values, (R, 2, B)."""
        n, rows = len(self.runs), self.shapes.batch_size
        return self._critic_pass.forward(layers, inputs.view(N_CRITICS * n, rows, -1)).view(n, N_CRITICS, rows)

    def _back(self, inputs: Tensor, gradients: Layers | None, inputs_from: int | None) -> Tensor | None:
        """Go back through the critics; return the derivative by the inputs summed over a run's critics, (R, B, .)."""
        n, rows = len(self.runs), self.shapes.batch_size
        d_values = self._d_critics.view(N_CRITICS * n, rows, 1)
        flat_inputs = inputs.view(N_CRITICS * n, rows, -1)
        d_inputs = self._critic_pass.backward(self.critics, flat_inputs, d_values, gradients, inputs_from)
        return None if d_inputs is None else d_inputs.view(n, N_CRITICS, rows, -1).sum(1)
