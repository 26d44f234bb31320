"""The peers that several benchmarks share: Stable-Baselines3 as its own documentation uses it.

Its environments are ours, `Hopper-v4` without gymnasium's checker, so that a difference is not one of settings.
"""

from collections.abc import Sequence

import torch
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

import otr
from pipelines.config.env import EnvConfig
from pipelines.play.environments import make_env

torch.set_num_threads(1)

HOPPER = EnvConfig("hopper", "hopper", "Hopper-v4")


def sac_with_actor(network: otr.ReluNetwork) -> SAC:
    """Return a SAC model on Hopper whose deterministic policy is `network`, of one hidden layer."""
    (width,) = network.hidden_widths
    model = SAC(
        "MlpPolicy",
        Monitor(make_env(HOPPER)),
        policy_kwargs={"net_arch": {"pi": [width], "qf": [256, 256]}},
        buffer_size=1,
        device="cpu",
        seed=0,
    )
    copy_layers((model.actor.latent_pi[0], model.actor.mu), network)
    return model


def copy_layers(layers: Sequence[torch.nn.Linear], network: otr.ReluNetwork) -> None:
    """Write the network's weights and biases into torch's layers."""
    with torch.no_grad():
        for layer, W, b in zip(layers, network.weights, network.biases, strict=True):
            layer.weight.copy_(torch.tensor(W))
            layer.bias.copy_(torch.tensor(b))
