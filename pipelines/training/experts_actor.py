"""Linear experts as an actor of the fleet's soft actor-critic."""

import math

import torch
from torch import Tensor, nn

from otr.control.experts import LinearExperts


class ExpertsActor(nn.Module):
    """Experts that give the means, and log standard deviations linear in the state.

    Attributes:
        penalty: () of the last `forward`, which the actor's loss has besides: how unevenly the experts are used.
    """

    penalty: Tensor

    def __init__(self, n_inputs: int, n_actions: int, n_experts: int, balance: float, generator: torch.Generator):
        """Draw experts as their class does, and the deviations' map as torch's Linear does."""
        super().__init__()
        self.mean = LinearExperts(n_inputs, n_actions, n_experts, generator=generator)
        self.log_std = nn.Linear(n_inputs, n_actions)
        self._balance, limit = balance, 1 / math.sqrt(n_inputs)
        with torch.no_grad():
            for parameter in self.log_std.parameters():
                parameter.uniform_(-limit, limit, generator=generator)

    def forward(self, states: Tensor) -> Tensor:
        means = self.mean(states)
        self.penalty = self._balance * self.mean.balance
        return torch.cat((means, self.log_std(states)), dim=1)
