"""Soft actor-critic of one run in plain torch: the losses of Haarnoja et al. (2018), differentiated by autograd.

The oracle of the hand-written gradients of `otr.control.sac.sac`; it computes in torch's default type.
"""

import math

import torch
from torch import Tensor, nn

from otr.control.sac.sac import FleetSac, Minibatch


class Dense(nn.Sequential):
    """Layers of which those after the first read the input beside the activations before them."""

    def forward(self, x: Tensor) -> Tensor:
        read = x
        for module in self:
            y = module(read)
            read = torch.cat([y, x], 1) if isinstance(module, nn.LeakyReLU) else y
        return y


def mlp(layers: list[tuple[Tensor, Tensor]], slope: float, dense: bool = False) -> nn.Sequential:
    """Return a (leaky) ReLU network with a copy of the given weights (w_in, w_out) and biases (1, w_out)."""
    modules: list[nn.Module] = []
    for weight, bias in layers:
        linear = nn.Linear(*weight.shape)
        linear.weight.data.copy_(weight.T)
        linear.bias.data.copy_(bias[0])
        modules += [linear, nn.LeakyReLU(slope)]
    return (Dense if dense else nn.Sequential)(*modules[:-1])


def linears(network: nn.Module) -> list[nn.Linear]:
    return [module for module in network.modules() if isinstance(module, nn.Linear)]


class AutogradSac:
    """The learner of run 0 of a fleet, with that run's parameters and settings."""

    def __init__(self, fleet: FleetSac, highest_value: float = math.inf) -> None:
        self.shapes, run, tensors = fleet.shapes, fleet.runs[0], fleet.tensors(0)

        def network(name: str, row: int) -> nn.Sequential:
            n_layers = sum(key.startswith(f"{name}.weight") for key in tensors)
            layers = [(tensors[f"{name}.weight{i}"][row], tensors[f"{name}.bias{i}"][row]) for i in range(n_layers)]
            return mlp(layers, self.shapes.negative_slope, self.shapes.dense and name == "actor")

        self.actor = network("actor", 0)
        self.critics, self.targets = (
            nn.ModuleList(network(name, i) for i in (0, 1)) for name in ("critics", "targets")
        )
        self.log_temperature = tensors["log_temperature"].clone().requires_grad_()
        self.gamma, self.learns_temperature = run.gamma, run.temperature is None
        rate, decay = run.learning_rate, run.weight_decay
        self.of_critics = torch.optim.Adam(self.critics.parameters(), rate, weight_decay=decay)
        self.of_actor = torch.optim.Adam(self.actor.parameters(), rate, weight_decay=decay)
        self.of_temperature = torch.optim.Adam([self.log_temperature], rate)
        self.n_updates, self.rate_share, self.highest_value = 0, 1.0, highest_value

    def act(self, states: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.actor(states).chunk(2, dim=1)
        normal = torch.distributions.Normal(mean, log_std.clamp(-20, 2).exp())
        unsquashed = normal.mean + normal.stddev * noise
        actions = unsquashed.tanh()
        return actions, (normal.log_prob(unsquashed) - torch.log(1 - actions**2 + 1e-6)).sum(1)

    def values(self, critics: nn.ModuleList, states: Tensor, actions: Tensor) -> Tensor:
        return torch.cat([critic(torch.cat([states, actions], 1)) for critic in critics], 1)

    def update(self, batch: Minibatch, noise: Tensor) -> Tensor:
        """Do one update with run 0's transitions, and return the critics' goal; gradients stay in the parameters."""
        states, actions, rewards, next_states, continues = (part[0] for part in vars(batch).values())
        noise, next_noise = noise[0].chunk(2)
        temperature = self.log_temperature.detach().exp()
        with torch.no_grad():
            next_actions, next_log_probability = self.act(next_states, next_noise)
            value = self.values(self.targets, next_states, next_actions).amin(1) - temperature * next_log_probability
            goal = (rewards + continues * self.gamma * value).clamp(max=self.highest_value)
        policy_actions, log_probability = self.act(states, noise)  # of the actor before its step
        inputs = torch.cat([states, actions], 1)
        self.step(self.of_critics, sum(0.5 * ((c(inputs)[:, 0] - goal) ** 2).mean() for c in self.critics))
        self.n_updates += 1
        if self.n_updates % self.shapes.actor_delay == 0:
            values = self.values(self.critics, states, policy_actions).amin(1)
            self.step(self.of_actor, (temperature * log_probability - values).mean())
            if self.learns_temperature:
                surplus = log_probability.detach() - actions.shape[1]
                self.step(self.of_temperature, -(self.log_temperature * surplus).mean())
        with torch.no_grad():
            for target, parameter in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
                target.lerp_(parameter, self.shapes.tau)
        return goal

    def step(self, optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
        parameters = optimiser.param_groups[0]["params"]
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = gradient
        (group,) = optimiser.param_groups
        group["lr"] = group.setdefault("first_lr", group["lr"]) * self.rate_share
        optimiser.step()
