"""What is known about a training run without running it: its key, its checkpoints, its likely time and disk.

Apart from `pipelines/stages/train.py`, because that imports torch, which planning and skipping need not wait for.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.config import OffPolicyConfig, OnPolicyConfig, RunConfig
from pipelines.config.settings import digest, env_settings, settings
from pipelines.engine.store import read_json
from pipelines.play.environments import make_env

TRAIN_VERSION = 1
HARDEN_VERSION = 1
FLEET_VERSION = 1  # of the fleet trainer alone; part of its runs' settings

FLEET_STEPS_PER_S = 400.0
RANDOM_STEPS_PER_S = 5_000.0  # off-policy steps before learning starts


def train_settings(config: RunConfig) -> dict[str, Any]:
    """Return what decides the trained actor; programs' names and later stages' settings do not."""
    everything = settings(config)
    env = env_settings(config.env)
    kept = {key: everything[key] for key in ("algo", "actor", "train", "seed")}
    if config.method.decides_training:
        kept["method"] = everything["method"]
    if config.fleet:
        kept["trainer"] = {**everything["trainer"], "version": FLEET_VERSION}
    return {"env": env, "hidden_widths": everything["depth"], **kept}


def harden_settings(config: RunConfig) -> dict[str, Any]:
    """Return what decides the hard tree, given the soft one."""
    return {"env": config.env.id, "feature_names": config.env.feature_names, "action_names": config.env.action_names}


def checkpoint_folder(config: RunConfig) -> Path:
    """Return where the run's checkpoints lie while it trains."""
    return Path(config.results_dir) / "checkpoints" / digest([TRAIN_VERSION, train_settings(config)])[:16]


def trained_steps(config: RunConfig) -> int:
    """Return how many environment steps the run's checkpoint holds; 0 where there is none."""
    histories = sorted(checkpoint_folder(config).glob("segment-*/history.json"))
    return int(read_json(histories[-1])["counters"]["num_timesteps"]) if histories else 0


def segment_steps(config: RunConfig) -> int:
    """Return the environment steps between two evaluations; PPO's are rounded up to whole rollouts,
    a fleet's to whole steps of its environments."""
    interval = min(config.train.eval_interval_steps, config.train.steps)
    if isinstance(config.algo, OnPolicyConfig):
        per_rollout = config.algo.n_steps * config.algo.n_envs
        return math.ceil(interval / per_rollout) * per_rollout
    if config.fleet:
        return math.ceil(interval / config.fleet.n_envs) * config.fleet.n_envs
    return interval


def estimated_seconds(config: RunConfig) -> float:
    """Return the likely time of what is left to train, in seconds on one core."""
    done, steps = trained_steps(config), config.train.steps
    random_steps = max(0, learning_starts(config) - done)
    return random_steps / RANDOM_STEPS_PER_S + max(0, steps - done - random_steps) / training_rate(config)


def training_rate(config: RunConfig) -> float:
    """Return the likely environment steps per second on one core, of a run or of all runs of a fleet together."""
    return FLEET_STEPS_PER_S if config.fleet else config.algo.steps_per_s


def estimated_bytes(config: RunConfig) -> int:
    """Return the likely size of the run's checkpoints: almost all of it is the replay buffer's log."""
    if not isinstance(config.algo, OffPolicyConfig):
        return 2**20
    env = make_env(config.env)
    assert env.observation_space.shape is not None and env.action_space.shape is not None
    assert env.observation_space.dtype is not None
    state_bytes = int(np.prod(env.observation_space.shape)) * env.observation_space.dtype.itemsize
    transition_bytes = 2 * state_bytes + 4 * int(np.prod(env.action_space.shape)) + 12
    env.close()
    return transition_bytes * min(config.algo.buffer_size, config.train.steps)


def learning_starts(config: RunConfig) -> int:
    """Return the random steps before learning: the algorithm's, the budget's limit, 0 for PPO."""
    if not isinstance(config.algo, OffPolicyConfig):
        return 0
    return min(config.algo.learning_starts, config.train.max_learning_starts, config.train.steps)
