"""What is known about a training before it runs: its segments, its random steps, its likely time and disk."""

import math

import numpy as np

from pipelines.config.algo import OffPolicyConfig
from pipelines.play.environments import make_env
from pipelines.training.settings import TrainSettings

FLEET_STEPS_PER_S = 290.0
RANDOM_STEPS_PER_S = 5_000.0  # off-policy steps before learning starts


def segment_steps(config: TrainSettings) -> int:
    """Return the environment steps between two evaluations: whole rollouts, and of a fleet whole steps of them all."""
    unit = config.fleet.n_envs if config.fleet else config.algo.rollout_steps
    return math.ceil(min(config.train.eval_interval_steps, config.train.steps) / unit) * unit


def estimated_seconds(config: TrainSettings, done: int) -> float:
    """Return the likely time of what is left to train after `done` steps, in seconds on one core."""
    steps = config.train.steps
    random_steps = max(0, learning_starts(config) - done)
    return random_steps / RANDOM_STEPS_PER_S + max(0, steps - done - random_steps) / training_rate(config)


def training_rate(config: TrainSettings) -> float:
    """Return the likely environment steps per second on one core, of a run or of all runs of a fleet together."""
    return FLEET_STEPS_PER_S if config.fleet else config.algo.training_rate


def estimated_bytes(config: TrainSettings) -> int:
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


def learning_starts(config: TrainSettings) -> int:
    """Return the random steps before learning: the algorithm's, the budget's limit, 0 for PPO."""
    if not isinstance(config.algo, OffPolicyConfig):
        return 0
    return min(config.algo.learning_starts, config.train.max_learning_starts, config.train.steps)
