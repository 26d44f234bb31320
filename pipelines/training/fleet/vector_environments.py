"""Environments side by side: gymnasium's here, EnvPool's with the same methods in `envpool_environments.py`.

Environment i depends on its own seed and its own actions alone, not on how many others there are. A run of a fleet
therefore sees what it would see alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import is_discrete, make_training_env


class Step(NamedTuple):
    """What one step of n environments gave; the arrays belong to the caller."""

    next_states: np.ndarray  # (n, d) float32, the true successors: where an episode ended, its terminal state
    rewards: np.ndarray  # (n,) float32, as in Stable-Baselines3's buffers
    terminated: np.ndarray  # (n,) bool, the episode ended in a terminal state
    truncated: np.ndarray  # (n,) bool, the time limit was reached; both may be true, as in gymnasium
    # (n, d) float32, to act on next: where an episode ended, the first state of the next one. The same array as
    # `next_states` where none ended.
    states: np.ndarray


class GymnasiumVectorEnv:
    """gymnasium's own environments, one after the other in this process; each starts its next episode by itself.

    On ten hoppers `SyncVectorEnv` costs 10 % beside a plain loop over the environments and 7 % with `copy=False`, which
    is what is used: what is returned is copied into float32 anyway.
    """

    def __init__(self, env: EnvConfig, n_envs: int, *, rescale_inputs: bool = False) -> None:
        def make() -> gym.Env:
            return make_training_env(env, rescale_inputs=rescale_inputs)

        self._envs = SyncVectorEnv([make] * n_envs, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)
        if is_discrete(self._envs.envs[0]):
            raise ConfigError(f"{env.id}: actions are labels, the fleet's are continuous; use trainer=sb3 and algo=ppo")
        self.n_envs = n_envs

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start every environment's random stream and an episode; return the first states, (n, d) float32."""
        states, _ = self._envs.reset(seed=[int(seed) for seed in seeds])
        return np.array(states, dtype=np.float32)

    def step(self, actions: np.ndarray) -> Step:
        """Do a step of all environments with actions (n, a) float32 in the environment's units."""
        observations, rewards, terminated, truncated, infos = self._envs.step(actions)
        states = np.array(observations, dtype=np.float32)
        next_states = states
        if "final_obs" in infos:
            next_states = states.copy()
            for i in np.flatnonzero(infos["_final_obs"]):
                next_states[i] = infos["final_obs"][i]
        return Step(next_states, rewards.astype(np.float32), terminated, truncated, states)

    def close(self) -> None:
        """End the environments; twice does no harm."""
        self._envs.close()
