"""Training: steps a second of our segmented trainer against a plain Stable-Baselines3 script with the same settings.

Ours is what `otr-run` does between two evaluations, which are left out: a segment (new environments, reseeding,
`learn`) and the checkpoint after it. The peer calls `learn` once for each stretch of the same length. Measured: SAC on
Hopper, two segments of 1,500 steps after 200 random ones, and PPO on Swimmer, three of 10,240 steps, with the settings
in conf/algo. The two take turns segment by segment, several times over; of each segment the fastest round counts.

Target: at least 0.97 of the peer's steps per second of CPU time.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

from benchmarks.measure import Entry
from pipelines.cli import runs
from pipelines.config.algo import PpoConfig, SacConfig
from pipelines.config.run import RunConfig
from pipelines.play.environments import make_env
from pipelines.training.checkpoints import History
from pipelines.training.progress import TrainingProgress
from pipelines.training.sb3.actor_kinds import actor_of
from pipelines.training.sb3.models import build_model
from pipelines.training.sb3.saved_models import save_checkpoint
from pipelines.training.sb3.training import train_segment

Segment = Callable[[], Any]


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick trains shorter segments, twice instead of five times."""
    rounds = 2 if quick else 5
    n_random, sac_steps, ppo_steps = (100, 200, 2_048) if quick else (200, 1_500, 10_240)
    sac = run_config("hopper", n_random + 2 * sac_steps, n_random + sac_steps, n_random)
    ppo = run_config("swimmer", 3 * ppo_steps, ppo_steps, 0)
    entries = []
    for config in (sac, ppo):
        ours, theirs = take_turns(config, rounds)
        name = f"{config.algo.name.upper()} {config.env.id}, {config.train.steps:,} steps"
        peer = "Stable-Baselines3 script"
        entries.append(Entry(f"{name}: training", ours, "steps/s", peer, theirs, "ratio >= 0.97"))
    return entries


def run_config(env: str, steps: int, segment_steps: int, n_random: int) -> RunConfig:
    """Return the configuration of `otr-run env=... depth=6 budget=thesis` with these steps."""
    overrides = [
        f"env={env}",
        "depth=6",
        "budget=thesis",
        f"train.steps={steps}",
        f"train.eval_interval_steps={segment_steps}",
        f"train.max_learning_starts={n_random}",
    ]
    return runs.run_config(overrides)


def take_turns(config: RunConfig, rounds: int) -> tuple[float, float]:
    """Return the steps per second of ours and of the peer: all steps over the sum of each segment's fastest round."""
    seconds: list[list[list[float]]] = [[], []]
    for i in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            trainers = [our_trainer(config, Path(folder)), plain_trainer(config)]
            spent: list[list[float]] = [[], []]
            n_steps = [0, 0]
            while n_steps[0] < config.train.steps:
                for side, (model, train_segment) in enumerate(trainers):
                    began = time.process_time()
                    train_segment()
                    spent[side].append(time.process_time() - began)
                    n_steps[side] = model.num_timesteps
            assert n_steps[0] == n_steps[1], f"ours did {n_steps[0]} steps, the peer {n_steps[1]}"
        for side in (0, 1):
            seconds[side].append(spent[side])
        rates = " against ".join(f"{n_steps[side] / sum(spent[side]):,.0f}" for side in (0, 1))
        print(f"training: {config.algo.name} round {i + 1} of {rounds} done, {rates} steps/s", flush=True)
    ours, theirs = (n_steps[side] / float(np.min(seconds[side], axis=0).sum()) for side in (0, 1))
    return ours, theirs


def our_trainer(config: RunConfig, folder: Path) -> tuple[BaseAlgorithm, Segment]:
    """Return the model that our trainer trains, and the function that trains it for one segment more."""
    model, history = build_model(config, seed=0), History()
    progress, actor = TrainingProgress(config, 0), actor_of(config)

    def train_on() -> None:
        start = model.num_timesteps
        history.progress.append(train_segment(model, actor, history.n_segments, progress))
        history.n_segments += 1
        save_checkpoint(folder, model, history, start)

    return model, train_on


def plain_trainer(config: RunConfig) -> tuple[BaseAlgorithm, Segment]:
    """Return the model of a script by Stable-Baselines3's documentation, and the function that trains it on."""
    algo = config.algo
    env = Monitor(make_env(config.env))
    common: dict[str, Any] = {"learning_rate": algo.learning_rate, "batch_size": algo.batch_size, "gamma": algo.gamma}
    common |= {"seed": 0, "device": "cpu"}
    model: BaseAlgorithm
    if isinstance(algo, SacConfig):
        n_actions = len(env.action_space.low)
        model = SAC(
            "MlpPolicy",
            env,
            **common,
            policy_kwargs={"net_arch": {"pi": [6], "qf": algo.critic}},
            buffer_size=config.train.steps + 1,
            learning_starts=config.train.max_learning_starts,
            tau=algo.tau,
            train_freq=algo.train_freq,
            gradient_steps=algo.gradient_steps,
            action_noise=NormalActionNoise(np.zeros(n_actions), np.full(n_actions, algo.action_noise_std)),
            ent_coef=algo.ent_coef,
        )
    else:
        assert isinstance(algo, PpoConfig)
        model = PPO(
            "MlpPolicy",
            env,
            **common,
            policy_kwargs={"net_arch": {"pi": [6], "vf": algo.critic}, "activation_fn": nn.ReLU},
            n_steps=algo.n_steps,
            n_epochs=algo.n_epochs,
            gae_lambda=algo.gae_lambda,
            clip_range=algo.clip_range,
            ent_coef=algo.ent_coef,
            vf_coef=algo.vf_coef,
            max_grad_norm=algo.max_grad_norm,
        )
    # Segments are as long as the interval between evaluations, and the last as long as what is left.
    interval = config.train.eval_interval_steps

    def train_segment() -> None:
        n_steps = min(interval, config.train.steps - model.num_timesteps)
        model.learn(n_steps, reset_num_timesteps=False)

    return model, train_segment
