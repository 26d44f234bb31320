"""An environment as a PID policy observes it: with the error, its sum over the last states, and its change."""

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np

from otr.control import pid_observation
from pipelines.config.env import PidTerms


class PidObservation(gym.Wrapper[np.ndarray, Any, np.ndarray, Any]):
    """Observations [s, P, I, D] in place of s (`otr.control.pid_observation`), of the state's own type.

    The history at the start of an episode is the first state, `n_history` times: then D = 0 and I = n_history * P.
    """

    def __init__(self, env: gym.Env[Any, Any], terms: PidTerms) -> None:
        """Wrap an environment whose states are vectors as long as `terms.goal`, which `make_env` checks."""
        super().__init__(env)
        space = env.observation_space
        assert isinstance(space, gym.spaces.Box)
        self._goal = np.asarray(terms.goal, dtype=np.float64)
        self._n_history = terms.n_history
        self._history: deque[np.ndarray] = deque(maxlen=terms.n_history)
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        least, most = self._goal - high, self._goal - low
        self.observation_space = gym.spaces.Box(
            np.concatenate((low, least, terms.n_history * least, low - high)).astype(space.dtype),
            np.concatenate((high, most, terms.n_history * most, high - low)).astype(space.dtype),
            dtype=space.dtype,
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Any]:
        state, info = self.env.reset(seed=seed, options=options)
        self._history.extend([np.array(state)] * self._n_history)
        return self._observation(state), info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        state, reward, terminated, truncated, info = self.env.step(action)
        observation = self._observation(state)
        self._history.append(np.array(state))
        return observation, float(reward), terminated, truncated, info

    def _observation(self, state: np.ndarray) -> np.ndarray:
        observation: np.ndarray = pid_observation(state, np.array(self._history), self._goal)
        return observation.astype(state.dtype)
