"""Environments side by side under one interface, whoever steps them: gymnasium here, EnvPool in `envpool_env.py`.

Environment i depends on its own seed and its own actions alone: not on how many others there are, nor on who steps them
(gymnasium in this process or in several). A run of a fleet therefore sees what it would see alone.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from pipelines.config import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import flat_state_size, is_discrete, make_training_env

BACKENDS = ("gymnasium", "envpool")


class Step(NamedTuple):
    """What one step of n environments gave; the arrays belong to the caller.

    Attributes:
        next_states: (n, d) float32, the true successors: where an episode ended, its terminal state.
        rewards: (n,) float32, as in Stable-Baselines3's buffers.
        terminated: (n,) bool, the episode ended in a terminal state.
        truncated: (n,) bool, the time limit was reached; both may be true, as in gymnasium.
        states: (n, d) float32, to act on next: where an episode ended, the first state of the next one. The same array
            as `next_states` where none ended.
    """

    next_states: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    states: np.ndarray


class VectorEnv(ABC):
    """`n_envs` environments that step together and start their next episode by themselves."""

    n_envs: int

    @abstractmethod
    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start an episode in every environment, and every environment's random stream anew.

        Args:
            seeds: one an environment, in 0 to 2**32 - 1; later episodes start from the environment's own stream.

        Returns:
            The first states, (n, d) float32.
        """

    @abstractmethod
    def send(self, actions: np.ndarray) -> None:
        """Start a step: (n, a) float32 in the environment's units, an array that is left alone until `receive`."""

    @abstractmethod
    def receive(self) -> Step:
        """Wait for the step that was sent, and return it."""

    def step(self, actions: np.ndarray) -> Step:
        """Send the actions and wait for the step. What can be computed meanwhile goes between `send` and `receive`."""
        self.send(actions)
        return self.receive()

    @abstractmethod
    def close(self) -> None:
        """End the environments, and the processes or threads that step them; twice does no harm."""


def make_vector_env(
    env: EnvConfig, n_envs: int, *, backend: str = "gymnasium", n_workers: int = 1, rescale_inputs: bool = False
) -> VectorEnv:
    """Return `n_envs` environments.

    Args:
        env: the environment; its actions are a box, its states a vector.
        n_envs: how many.
        backend: gymnasium, or envpool, which needs the extra `fleet` and knows some of the MuJoCo environments.
        n_workers: gymnasium's processes (1: this process itself), or EnvPool's threads.
        rescale_inputs: give states rescaled from the environment's box to [-1, 1].

    Raises:
        ConfigError: the environment cannot be made, or not by this backend.
        PipelineError: EnvPool is not installed.
    """
    if backend == "envpool":
        from pipelines.training.fleet.envpool_environments import EnvPoolVectorEnv

        if rescale_inputs:
            raise ConfigError("actor.rescale_inputs=true: the states of EnvPool's environments have no bounds")
        return EnvPoolVectorEnv(env, n_envs, n_threads=n_workers)
    if backend != "gymnasium":
        raise ConfigError(f"backend={backend!r} of environments: use {' or '.join(BACKENDS)}")
    if n_workers > 1:
        from pipelines.training.fleet.process_env import ProcessVectorEnv

        return ProcessVectorEnv(env, n_envs, n_workers=n_workers, rescale_inputs=rescale_inputs)
    return GymnasiumVectorEnv(env, n_envs, rescale_inputs=rescale_inputs)


class GymnasiumVectorEnv(VectorEnv):
    """gymnasium's own environments, one after the other in this process.

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
        self.n_state_components = flat_state_size(self._envs.envs[0])
        self.n_action_components = int(np.prod(self._envs.single_action_space.shape or ()))
        self._actions: np.ndarray | None = None

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        check_seeds(seeds, self.n_envs)
        self._actions = None
        states, _ = self._envs.reset(seed=[int(seed) for seed in seeds])
        return np.array(states, dtype=np.float32)

    def send(self, actions: np.ndarray) -> None:
        check_actions(actions, self.n_envs)
        self._actions = actions

    def receive(self) -> Step:
        """Compute the step that was sent: in one process nothing overlaps."""
        assert self._actions is not None, "receive without send"
        observations, rewards, terminated, truncated, infos = self._envs.step(self._actions)
        self._actions = None
        states = np.array(observations, dtype=np.float32)
        next_states = states
        if "final_obs" in infos:
            next_states = states.copy()
            for i in np.flatnonzero(infos["_final_obs"]):
                next_states[i] = infos["final_obs"][i]
        return Step(next_states, rewards.astype(np.float32), terminated, truncated, states)

    def close(self) -> None:
        self._envs.close()


def check_seeds(seeds: Sequence[int], n_envs: int) -> None:
    """Refuse a number of seeds that is not the number of environments."""
    if len(seeds) != n_envs:
        raise ValueError(f"{len(seeds)} seeds for {n_envs} environments: give one each")


def check_actions(actions: np.ndarray, n_envs: int) -> None:
    """Refuse actions that are not one row an environment."""
    if actions.ndim != 2 or len(actions) != n_envs:
        raise ValueError(f"actions {actions.shape} for {n_envs} environments: give one row each")
