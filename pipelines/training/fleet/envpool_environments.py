"""EnvPool's environments (the extra `fleet`): batched C++, for the MuJoCo ones that it computes as gymnasium does.

EnvPool brings its own MuJoCo, 3.6.0. `tests/pipelines/training/fleet/test_envpool_environments.py` sets gymnasium's
environment to the state of EnvPool's before every step and compares what follows.
"""

import importlib
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError, PipelineError
from pipelines.training.fleet.vector_environments import Step

# The same ids in both. One step's states and rewards were equal to 4e-7, the ends of episodes exactly. Ant is another
# one: MuJoCo 4 integrates its free body's rotation by another Runge-Kutta step than EnvPool's MuJoCo 3.6.
EQUAL_NAMES = ("HalfCheetah", "Hopper", "Reacher", "Swimmer", "Walker2d")
EQUAL_IDS = tuple(f"{name}-{version}" for name in EQUAL_NAMES for version in ("v4", "v5"))


class EnvPoolVectorEnv:
    """Environments of one pool, of EQUAL_IDS, each with its own seed, stepped by one thread.

    Where an episode ended, its environment is reset at once, so that no step is lost to a reset. The time limit is kept
    here, because EnvPool's own hides a terminal state that is reached with the last step.
    """

    def __init__(self, env: EnvConfig, n_envs: int) -> None:
        self._id, self._max_episode_steps = env.id, _time_limit(env)
        _envpool()  # a missing one is told at once
        self.n_envs = n_envs
        self._pool: Any = None
        self._n_steps = np.zeros(n_envs, dtype=np.int64)  # of the episodes under way

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start anew in a new pool: EnvPool takes seeds only when one is made (about 20 ms for ten hoppers)."""
        self._pool = make_pool(self._id, seeds)
        self._n_steps[:] = 0
        states, _ = self._pool.reset()
        return np.array(states, dtype=np.float32)

    def step(self, actions: np.ndarray) -> Step:
        observations, rewards, terminated, _, _ = self._pool.step(actions)
        next_states = states = observations.astype(np.float32)
        self._n_steps += 1
        truncated = self._n_steps >= self._max_episode_steps
        ended = np.flatnonzero(terminated | truncated).astype(np.int32)
        if len(ended):
            first_states, _ = self._pool.reset(ended)
            states = next_states.copy()
            states[ended] = first_states
            self._n_steps[ended] = 0
        return Step(next_states, rewards.astype(np.float32), terminated.copy(), truncated, states)

    def close(self) -> None:
        self._pool = None  # its thread ends with it


def make_pool(env_id: str, seeds: Sequence[int]) -> Any:
    """Return EnvPool's own environments, one a seed, without a time limit."""
    return _envpool().make_gymnasium(
        env_id,
        num_envs=len(seeds),
        num_threads=1,
        seed=np.asarray(seeds, dtype=np.uint32).astype(np.int32),  # one to one; EnvPool's seeds are int32
        max_episode_steps=2**30,
    )


def _time_limit(env: EnvConfig) -> int:
    """Return the most steps of an episode; refuse arguments, with which EnvPool was not compared."""
    others = sorted(env.kwargs.keys() - {"max_episode_steps"})
    if others:
        raise ConfigError(f"EnvPool's {env.id} is compared without arguments, but env.kwargs has {', '.join(others)}")
    limit = env.kwargs.get("max_episode_steps") or gym.spec(env.id).max_episode_steps
    assert limit is not None  # every one of EQUAL_IDS has one
    return limit


def _envpool() -> Any:
    try:
        return importlib.import_module("envpool")
    except ImportError as error:
        raise PipelineError(f"EnvPool's environments need the extra: pip install '.[fleet]' ({error})") from error
