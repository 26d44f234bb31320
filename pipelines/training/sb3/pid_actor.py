"""An actor that is a PID controller with gains from a small network, under DDPG of Stable-Baselines3.

The actor reads [s, P, I, D] (`otr.control.pid_observation`) and acts as tanh(theta(s) . [P, I, D]). The L1 penalty on
the gains' output weights (Orfanos 2023, section 4.1.1), so that they are nearly constant, is added to their gradient:
the loss becomes ``-mean Q + l1 * sum |W_out|``, and Stable-Baselines3's training loop stays as it is.
"""

from typing import Any

import gymnasium as gym
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

import otr
from otr.control import pid_network
from pipelines.config.methods import PidConfig
from pipelines.training.sb3.relu_actor import ReluActor
from pipelines.training.settings import TrainSettings

# The gains' output weights and biases at first, as in Lillicrap et al. (2016), so that actions begin near zero: torch's
# defaults are up to 1, which the integral, up to 40, turns into a saturated tanh.
INITIAL_GAIN = 3e-3


class PidActor(ReluActor):
    """A PID controller as the actor; its files are those of the network of [s, P, I, D]."""

    def __init__(self, config: TrainSettings) -> None:
        super().__init__(config)
        assert isinstance(config.method, PidConfig)
        self.method = config.method

    def policy_class(self) -> type[TD3Policy]:
        return PidPolicy

    def policy_kwargs(self) -> dict[str, Any]:
        return {"l1": self.method.l1, "first_layer_scale": self.method.first_layer_scale}

    def segment_learnt(self, model: BaseAlgorithm) -> None:
        """Set the gains' output weights below `zero_below` to zero."""
        weight = _controller(model).gains[-1].weight
        with torch.no_grad():
            weight[weight.abs() < self.method.zero_below] = 0.0  # type: ignore[operator]

    def exported(self, model: BaseAlgorithm) -> otr.ReluNetwork:
        box = model.action_space
        assert isinstance(box, gym.spaces.Box)
        gains = otr.from_torch(_controller(model).gains)
        network: otr.ReluNetwork = pid_network(gains, box.low.ravel(), box.high.ravel())
        return network


class PidController(nn.Module):
    """tanh(theta(s) . [P, I, D]) of observations (n, 4 d): one gain a term and action, (n, a).

    `gains` is Linear, (leaky) ReLU, ..., Linear from s (d,) to theta (a * 3 d,).
    """

    def __init__(self, gains: nn.Sequential, n_actions: int) -> None:
        super().__init__()
        self.gains, self.n_actions = gains, n_actions

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        d = observations.shape[1] // 4
        states, terms = observations[:, :d], observations[:, d:]
        theta = self.gains(states).view(len(observations), self.n_actions, 3 * d)
        return torch.tanh((theta * terms[:, None]).sum(dim=2))


class PidControllerActor(Actor):
    """Stable-Baselines3's actor with a `PidController` in place of its network."""

    mu: PidController  # type: ignore[assignment]

    def __init__(self, *args: Any, l1: float, first_layer_scale: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        n_states, n_actions = self.features_dim // 4, get_action_dim(self.action_space)
        layers = create_mlp(n_states, n_actions * 3 * n_states, self.net_arch, self.activation_fn)
        with torch.no_grad():
            for parameter in layers[0].parameters() if self.net_arch else ():
                parameter.mul_(first_layer_scale)
            for parameter in layers[-1].parameters():
                parameter.uniform_(-INITIAL_GAIN, INITIAL_GAIN)
        self.mu = PidController(nn.Sequential(*layers), n_actions)
        weight = self.mu.gains[-1].weight
        assert isinstance(weight, nn.Parameter)
        weight.register_hook(lambda gradient: gradient + l1 * weight.detach().sign())  # type: ignore[no-untyped-call]


class PidPolicy(TD3Policy):
    """DDPG's policy with a `PidControllerActor`, which takes `l1` and `first_layer_scale`."""

    actor: PidControllerActor

    def __init__(self, *args: Any, l1: float = 0.0, first_layer_scale: float = 1.0, **kwargs: Any) -> None:
        self.own: dict[str, Any] = {"l1": l1, "first_layer_scale": first_layer_scale}
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: Any = None) -> PidControllerActor:
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return PidControllerActor(**kwargs, **self.own).to(self.device)


def _controller(model: BaseAlgorithm) -> PidController:
    assert isinstance(model.policy, PidPolicy)
    return model.policy.actor.mu
