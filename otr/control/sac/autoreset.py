"""Environments that restart automatically, for training.

A run of a fleet sees what it would see alone, because an environment does not depend on the number of others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from otr.control.environments import VectorEnv


class Step(NamedTuple):
    """The result of a step of n environments that restart automatically; the arrays belong to the caller."""

    next_states: np.ndarray  # (n, d) float32, the true successors: where an episode ended, its last state
    rewards: np.ndarray  # (n,) float32, as in Stable-Baselines3's buffers
    terminated: np.ndarray  # (n,) bool, the episode ended in a terminal state
    truncated: np.ndarray  # (n,) bool, the time limit was reached; both may be true, as in gymnasium
    states: np.ndarray  # (n, d) float32, to act on next: where an episode ended, the first state of the next one


class Autoreset:
    """Environments for training, which has no episodes to play: each restarts automatically. All in float32."""

    def __init__(self, envs: VectorEnv) -> None:
        self._envs = envs

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start every environment's random stream and an episode; return the first states, (n, d) float32."""
        return self._envs.reset(seeds).astype(np.float32)

    def step(self, actions: np.ndarray) -> Step:
        """Do a step of all environments with actions (n, a) in the environment's units."""
        stepped = self._envs.step(actions)
        next_states = states = stepped.states.astype(np.float32)
        ended = np.flatnonzero(stepped.terminated | stepped.truncated)
        if len(ended):
            states = next_states.copy()
            states[ended] = self._envs.reset(None, ended)
        return Step(next_states, stepped.rewards.astype(np.float32), stepped.terminated, stepped.truncated, states)

    def close(self) -> None:
        """End the environments; twice does no harm."""
        self._envs.close()
