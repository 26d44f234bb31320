"""Stable-Baselines3 models from our configuration: a small actor, critics of the usual size."""

import functools
from dataclasses import fields
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from pipelines.config.algo import (
    AlgoConfig,
    ContinuousConfig,
    DdpgConfig,
    DqnConfig,
    GradientConfig,
    OffPolicyConfig,
    PpoConfig,
    SacConfig,
    Td3Config,
)
from pipelines.errors import ConfigError
from pipelines.play.environments import flat_state_size, is_discrete
from pipelines.play.spaces import make_training_env
from pipelines.training.estimates import learning_starts
from pipelines.training.sb3.actor_kinds import actor_of
from pipelines.training.sb3.normalisation import normalised
from pipelines.training.sb3.relu_actor import ReluActor
from pipelines.training.settings import TrainSettings

torch.set_num_threads(1)  # two threads make these small networks a hundred times slower


ALGORITHMS: dict[type[AlgoConfig], type[BaseAlgorithm]] = {
    PpoConfig: PPO,
    DqnConfig: DQN,
    SacConfig: SAC,
    Td3Config: TD3,
    DdpgConfig: DDPG,
}
# The settings of an algorithm that its class lacks, under that name or at all; all others are passed on.
OTHER_SETTINGS = ("name", "critic", "weight_decay", "n_envs", "normalise", "action_noise_std", "action_noise_dt",
                  "exploration_fraction", "exploration_final_eps", *SacConfig.of_fleets())  # fmt: skip


def build_model(config: TrainSettings, seed: int) -> BaseAlgorithm:
    """Return an untrained model on its own environments, reproducible from `seed`."""
    algo = config.algo
    env = build_env(config)
    single = cast(DummyVecEnv, env.unwrapped).envs[0]
    flat_state_size(single)
    assert isinstance(algo, GradientConfig)
    _check_actions(config, is_discrete(single))
    options: dict[str, Any] = {field.name: getattr(algo, field.name) for field in fields(algo)}
    options = {name: value for name, value in options.items() if name not in OTHER_SETTINGS}
    if isinstance(algo, OffPolicyConfig):
        options["buffer_size"] = min(algo.buffer_size, config.train.steps + 1)
        options["learning_starts"] = learning_starts(config)
    if isinstance(algo, ContinuousConfig):
        options["action_noise"] = _action_noise(algo, int(np.prod(single.action_space.shape or ())))
    if isinstance(algo, SacConfig) and algo.ent_coef != "auto":
        options["ent_coef"] = float(algo.ent_coef)
    actor = actor_of(config)
    policy, policy_kwargs = actor.policy_class(), _policy_kwargs(algo, actor)
    model = ALGORITHMS[type(algo)](policy, env, policy_kwargs=policy_kwargs, seed=seed, device="cpu", **options)
    if isinstance(algo, DqnConfig):
        _explore_by_steps(model, algo, config.train.steps)
    return model


def _check_actions(config: TrainSettings, discrete: bool) -> None:
    """Refuse an algorithm that is not for the environment's kind of actions."""
    algo, env_id = config.algo, config.env.id
    if isinstance(algo, PpoConfig) and algo.use_sde and discrete:
        raise ConfigError(f"algo.use_sde needs continuous actions; {env_id} has labels")
    if isinstance(algo, DqnConfig) and not discrete:
        raise ConfigError(f"algo=dqn needs labels; {env_id} has continuous actions: use algo=sac")
    if isinstance(algo, ContinuousConfig) and discrete:
        raise ConfigError(f"algo={algo.name} needs continuous actions; {env_id} has labels: use algo=ppo")


def build_env(config: TrainSettings) -> VecEnv:
    """Return new training environments: one, or as many side by side as PPO is set to use, normalised if it is set."""
    n_envs = config.algo.n_envs if isinstance(config.algo, PpoConfig) else 1

    def make() -> gym.Env:
        return Monitor(make_training_env(config.env, rescale_inputs=config.actor.rescale_inputs))

    env = DummyVecEnv([make] * n_envs)
    return normalised(env, config)


def _policy_kwargs(algo: GradientConfig, actor: ReluActor) -> dict[str, Any]:
    """Return the network shapes: the actor's are `depth`, the critics' the algorithm's, activations (leaky) ReLU."""
    critics = "vf" if isinstance(algo, PpoConfig) else "qf"
    slope = actor.config.actor.negative_slope
    widths = actor.net_arch()
    kwargs: dict[str, Any] = {
        "net_arch": widths if isinstance(algo, DqnConfig) else {"pi": widths, critics: list(algo.critic)},
        "activation_fn": functools.partial(torch.nn.LeakyReLU, slope) if slope > 0.0 else torch.nn.ReLU,
        **actor.policy_kwargs(),
    }
    if algo.weight_decay > 0.0:
        # Stable-Baselines3 gives PPO's Adam a larger epsilon, but only where no other argument is set.
        epsilon = {"eps": 1e-5} if isinstance(algo, PpoConfig) else {}
        kwargs["optimizer_kwargs"] = {"weight_decay": algo.weight_decay, **epsilon}
    return kwargs


def _explore_by_steps(model: BaseAlgorithm, algo: DqnConfig, n_steps: int) -> None:
    """Let a DQN's share of random actions fall by the steps done.

    Stable-Baselines3's own measure of progress restarts with each segment.
    """

    def share_of_random_actions(progress_remaining: float) -> float:
        done = min(1.0, model.num_timesteps / (algo.exploration_fraction * n_steps))
        return 1.0 + done * (algo.exploration_final_eps - 1.0)

    assert isinstance(model, DQN)
    model.exploration_schedule = share_of_random_actions


def _action_noise(algo: ContinuousConfig, n_actions: int) -> ActionNoise | None:
    mean, std = np.zeros(n_actions), np.full(n_actions, algo.action_noise_std)
    if algo.action_noise == "normal":
        return NormalActionNoise(mean, std)
    if algo.action_noise == "ornstein_uhlenbeck":
        return OrnsteinUhlenbeckActionNoise(mean, std, dt=algo.action_noise_dt)
    return None
