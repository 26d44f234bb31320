"""Stable-Baselines3 models from our configuration: a small actor, critics of the usual size."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import TRPO
from stable_baselines3 import DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from pipelines.config import (
    ArsConfig,
    ContinuousConfig,
    DdpgConfig,
    DqnConfig,
    GradientConfig,
    OnPolicyConfig,
    PpoConfig,
    RunConfig,
    SacConfig,
    Td3Config,
    TrpoConfig,
)
from pipelines.errors import ConfigError
from pipelines.play.environments import flat_state_size, is_discrete, make_training_env
from pipelines.training.actors import actor_of
from pipelines.training.estimates import learning_starts
from pipelines.training.random_search import build_ars
from pipelines.training.relu_actor import ReluActor

torch.set_num_threads(1)  # two threads make these small networks a hundred times slower
torch.set_flush_denormal(True)  # decayed weights become denormal numbers, which are many times slower and worth nothing


def build_model(config: RunConfig, seed: int) -> BaseAlgorithm:
    """Return an untrained model on its own environments, reproducible from `seed`."""
    algo = config.algo
    env = build_env(config)
    single = env.envs[0]
    flat_state_size(single)
    if isinstance(algo, ArsConfig):
        return build_ars(env, algo, seed)
    assert isinstance(algo, GradientConfig)
    if isinstance(algo, PpoConfig) and algo.use_sde and is_discrete(single):
        raise ConfigError(f"algo.use_sde needs continuous actions; {config.env.id} has labels")
    actor = actor_of(config)
    common: dict[str, Any] = {
        "policy": actor.policy_class(),
        "env": env,
        "learning_rate": algo.learning_rate,
        "batch_size": algo.batch_size,
        "gamma": algo.gamma,
        "policy_kwargs": _policy_kwargs(algo, actor),
        "seed": seed,
        "device": "cpu",
    }
    if isinstance(algo, OnPolicyConfig):
        return _on_policy_model(algo, common | {"n_steps": algo.n_steps, "gae_lambda": algo.gae_lambda})
    if isinstance(algo, DqnConfig):
        return _dqn_model(algo, common, config, single)
    if is_discrete(single):
        raise ConfigError(f"algo={algo.name} needs continuous actions; {config.env.id} has labels: use algo=ppo")
    assert isinstance(algo, ContinuousConfig)
    assert single.action_space.shape is not None
    return _off_policy_model(algo, common, config, int(np.prod(single.action_space.shape)))


def build_env(config: RunConfig) -> DummyVecEnv:
    """Return new training environments: one, or as many side by side as PPO is set to use."""
    n_envs = config.algo.n_envs if isinstance(config.algo, OnPolicyConfig) else 1

    def make() -> gym.Env:
        return Monitor(make_training_env(config.env, rescale_inputs=config.actor.rescale_inputs))

    return DummyVecEnv([make] * n_envs)


def _policy_kwargs(algo: GradientConfig, actor: ReluActor) -> dict[str, Any]:
    """Return the network shapes: the actor's are `depth`, the critics' the algorithm's, activations (leaky) ReLU."""
    critics = "vf" if isinstance(algo, OnPolicyConfig) else "qf"
    slope = actor.config.actor.negative_slope
    widths = actor.net_arch()
    kwargs: dict[str, Any] = {
        "net_arch": widths if isinstance(algo, DqnConfig) else {"pi": widths, critics: list(algo.critic)},
        "activation_fn": functools.partial(torch.nn.LeakyReLU, slope) if slope > 0.0 else torch.nn.ReLU,
        **actor.policy_kwargs(),
    }
    if algo.weight_decay > 0.0:
        # Stable-Baselines3 gives PPO's Adam a larger epsilon, but only where no other argument is set.
        epsilon = {"eps": 1e-5} if isinstance(algo, OnPolicyConfig) else {}
        kwargs["optimizer_kwargs"] = {"weight_decay": algo.weight_decay, **epsilon}
    return kwargs


def _on_policy_model(algo: OnPolicyConfig, common: dict[str, Any]) -> BaseAlgorithm:
    if isinstance(algo, TrpoConfig):
        return TRPO(
            **common,
            target_kl=algo.target_kl,
            cg_max_steps=algo.cg_max_steps,
            cg_damping=algo.cg_damping,
            n_critic_updates=algo.n_critic_updates,
        )
    assert isinstance(algo, PpoConfig)
    return PPO(
        **common,
        n_epochs=algo.n_epochs,
        clip_range=algo.clip_range,
        ent_coef=algo.ent_coef,
        vf_coef=algo.vf_coef,
        max_grad_norm=algo.max_grad_norm,
        use_sde=algo.use_sde,
        sde_sample_freq=algo.sde_sample_freq,
    )


def _dqn_model(algo: DqnConfig, common: dict[str, Any], config: RunConfig, env: gym.Env) -> DQN:
    if not is_discrete(env):
        raise ConfigError(f"algo=dqn needs labels; {config.env.id} has continuous actions: use algo=sac")
    model = DQN(
        **common,
        buffer_size=min(algo.buffer_size, config.train.steps + 1),
        learning_starts=learning_starts(config),
        tau=algo.tau,
        train_freq=algo.train_freq,
        gradient_steps=algo.gradient_steps,
        target_update_interval=algo.target_update_interval,
        max_grad_norm=algo.max_grad_norm,
    )

    def share_of_random_actions(progress_remaining: float) -> float:
        # By the steps done: Stable-Baselines3's own measure of progress begins anew with each segment.
        done = min(1.0, model.num_timesteps / (algo.exploration_fraction * config.train.steps))
        return 1.0 + done * (algo.exploration_final_eps - 1.0)

    model.exploration_schedule = share_of_random_actions
    return model


def _off_policy_model(
    algo: ContinuousConfig, common: dict[str, Any], config: RunConfig, n_actions: int
) -> BaseAlgorithm:
    common |= {
        "buffer_size": min(algo.buffer_size, config.train.steps + 1),
        "learning_starts": learning_starts(config),
        "tau": algo.tau,
        "train_freq": algo.train_freq,
        "gradient_steps": algo.gradient_steps,
        "action_noise": _action_noise(algo, n_actions),
    }
    if isinstance(algo, SacConfig):
        ent_coef = algo.ent_coef if algo.ent_coef.startswith("auto") else float(algo.ent_coef)
        return SAC(**common, ent_coef=ent_coef)
    if isinstance(algo, Td3Config):
        return TD3(
            **common,
            policy_delay=algo.policy_delay,
            target_policy_noise=algo.target_policy_noise,
            target_noise_clip=algo.target_noise_clip,
        )
    assert isinstance(algo, DdpgConfig)
    return DDPG(**common)


def _action_noise(algo: ContinuousConfig, n_actions: int) -> ActionNoise | None:
    mean, std = np.zeros(n_actions), np.full(n_actions, algo.action_noise_std)
    if algo.action_noise == "normal":
        return NormalActionNoise(mean, std)
    if algo.action_noise == "ornstein_uhlenbeck":
        return OrnsteinUhlenbeckActionNoise(mean, std, dt=algo.action_noise_dt)
    if algo.action_noise == "none":
        return None
    raise ConfigError(f"algo.action_noise={algo.action_noise}: use normal, ornstein_uhlenbeck or none")
