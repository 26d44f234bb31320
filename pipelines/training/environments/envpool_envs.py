"""EnvPool's environments (the extra `fleet`): batched C++, for the MuJoCo ones that it computes as gymnasium does.

EnvPool brings its own MuJoCo, 3.6.0. `tests/pipelines/training/environments/test_envpool_envs.py` sets gymnasium's
environment to the state of EnvPool's before every step and compares what follows.
"""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipelines.config.env import EnvConfig
from pipelines.errors import PipelineError
from pipelines.training.environments.vector_envs import Stepped, time_limit

# The same ids in both. One step's states and rewards were equal to 4e-7, the ends of episodes exactly. Ant is another
# one: MuJoCo 4 integrates its free body's rotation by another Runge-Kutta step than EnvPool's MuJoCo 3.6.
EQUAL_NAMES = ("HalfCheetah", "Hopper", "Reacher", "Swimmer", "Walker2d")
EQUAL_IDS = tuple(f"{name}-{version}" for name in EQUAL_NAMES for version in ("v4", "v5"))


class EnvPoolVectorEnv:
    """Environments of one pool, of EQUAL_IDS (`VectorEnv`), each with its own seed, stepped by one thread.

    Their random streams are drawn from at resets alone, so that those of equal seeds stay in step. The time limit is
    kept here, because EnvPool's own hides a terminal state that is reached with the last step.
    """

    def __init__(self, env: EnvConfig, n_envs: int) -> None:
        """Prepare the environments, which `reset` makes.

        Raises:
            ConfigError: EnvPool was not compared with these arguments.
            PipelineError: EnvPool is not installed.
        """
        self._id, self._max_episode_steps = env.id, time_limit(env, "envpool")
        _envpool()  # a missing one is told at once
        self.n_envs = n_envs
        self._pool: Any = None
        self._n_steps = np.zeros(n_envs, dtype=np.int64)  # of the episodes under way

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start anew in a new pool: EnvPool takes seeds only when one is made (about 20 ms for ten hoppers)."""
        self._pool = make_pool(self._id, seeds)
        self._n_steps[:] = 0
        states, _ = self._pool.reset()
        return np.array(states)

    def restart(self, envs: np.ndarray) -> np.ndarray:
        self._n_steps[envs] = 0
        states, _ = self._pool.reset(envs.astype(np.int32))
        return np.array(states)

    def step(self, actions: np.ndarray, envs: np.ndarray | None = None) -> Stepped:
        states, rewards, terminated, _, _ = self._pool.step(actions, envs)
        index = slice(None) if envs is None else envs
        self._n_steps[index] += 1
        truncated = self._n_steps[index] >= self._max_episode_steps
        return Stepped(states.copy(), rewards.copy(), terminated.copy(), truncated)

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


def _envpool() -> Any:
    try:
        return importlib.import_module("envpool")
    except ImportError as error:
        raise PipelineError(f"EnvPool's environments need the extra: pip install '.[fleet]' ({error})") from error
