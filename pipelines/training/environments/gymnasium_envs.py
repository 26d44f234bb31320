"""gymnasium's own environments, one after the other in this process."""

from collections.abc import Sequence

import gymnasium as gym
import numpy as np

from pipelines.config.env import EnvConfig
from pipelines.play.environments import flat_state_size, is_discrete
from pipelines.play.spaces import make_training_env
from pipelines.training.environments.vector_envs import Stepped


class GymnasiumVectorEnv:
    """Any environments of gymnasium's (`VectorEnv`).

    A plain loop: `SyncVectorEnv` costs 7 to 10 % beside it on ten hoppers, and cannot step some of its environments.
    """

    def __init__(self, env: EnvConfig, n_envs: int, *, rescale_inputs: bool = False) -> None:
        """Make the environments.

        Raises:
            ConfigError: there is no such environment, or its states are no vector, its actions are neither labels
                nor a box, or `rescale_inputs` is set and its states have no bounds.
        """
        self.n_envs = n_envs
        self._envs = [make_training_env(env, rescale_inputs=rescale_inputs) for _ in range(n_envs)]
        self._n_inputs, self._dtype = flat_state_size(self._envs[0]), self._envs[0].observation_space.dtype
        self._discrete = is_discrete(self._envs[0])
        # The environments of conf/env take actions as they are, in float64 from searches: committed searches stay as
        # they are bit for bit. All others, which may insist on it, get actions of their own space.
        space = self._envs[0].action_space
        self._box = space if isinstance(space, gym.spaces.Box) and not env.has_file else None

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        states = self._empty_states(self.n_envs)
        for i, (env, seed) in enumerate(zip(self._envs, seeds, strict=True)):
            states[i], _ = env.reset(seed=int(seed))
        return states

    def restart(self, envs: np.ndarray) -> np.ndarray:
        states = self._empty_states(len(envs))
        for j, i in enumerate(envs):
            states[j], _ = self._envs[i].reset()
        return states

    def step(self, actions: np.ndarray, envs: np.ndarray | None = None) -> Stepped:
        stepped = self._envs if envs is None else [self._envs[i] for i in envs]
        n = len(stepped)
        states, rewards = self._empty_states(n), np.empty(n)
        terminated, truncated = np.empty(n, dtype=bool), np.empty(n, dtype=bool)
        if self._box is not None:
            rounded = np.rint(actions) if np.issubdtype(self._box.dtype, np.integer) else actions
            actions = rounded.astype(self._box.dtype).reshape(n, *self._box.shape)
        each = actions.tolist() if self._discrete else actions
        for j, (env, action) in enumerate(zip(stepped, each, strict=True)):
            states[j], rewards[j], terminated[j], truncated[j], _ = env.step(action)
        return Stepped(states, rewards, terminated, truncated)

    def close(self) -> None:
        while self._envs:
            self._envs.pop().close()

    def _empty_states(self, n: int) -> np.ndarray:
        return np.empty((n, self._n_inputs), dtype=self._dtype)
