"""The interface of environments side by side, and `Autoreset`, in which each starts its next episode by itself.

Environment i depends on its own seed and its own actions alone, not on how many others there are. A run of a fleet
therefore sees what it would see alone.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import spec_of


class Stepped(NamedTuple):
    """What one step of k environments gave; the arrays belong to the caller."""

    states: np.ndarray  # (k, d), of the environment's own type; where an episode ended, its last state
    rewards: np.ndarray  # (k,), of the environment's own type
    terminated: np.ndarray  # (k,) bool, the episode ended in a terminal state
    truncated: np.ndarray  # (k,) bool, the time limit was reached; both may be true, as in gymnasium


class VectorEnv(Protocol):
    """n environments of one kind.

    An environment whose episode has ended is not stepped again until its next episode was started.
    """

    n_envs: int

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start every environment's random stream anew, and an episode; return the first states, (n, d).

        Args:
            seeds: (n,) whole numbers from 0 to 2**32 - 1; equal seeds give equal episodes.
        """
        ...

    def restart(self, envs: np.ndarray) -> np.ndarray:
        """Start the next episode of some environments, each in its own random stream, as gymnasium's reset() does.

        Args:
            envs: (k,) distinct indices.

        Returns:
            Their first states, (k, d).
        """
        ...

    def step(self, actions: np.ndarray, envs: np.ndarray | None = None) -> Stepped:
        """Do a step of some environments, or of all; the others stay as they are.

        Args:
            actions: (k, a) in the environment's units, or (k,) labels.
            envs: (k,) distinct indices; None for all.
        """
        ...

    def close(self) -> None:
        """End the environments; twice does no harm."""
        ...


class Step(NamedTuple):
    """What one step of n environments gave that restart by themselves; the arrays belong to the caller."""

    next_states: np.ndarray  # (n, d) float32, the true successors: where an episode ended, its last state
    rewards: np.ndarray  # (n,) float32, as in Stable-Baselines3's buffers
    terminated: np.ndarray  # (n,) bool, the episode ended in a terminal state
    truncated: np.ndarray  # (n,) bool, the time limit was reached; both may be true, as in gymnasium
    # (n, d) float32, to act on next: where an episode ended, the first state of the next one. The same array as
    # `next_states` where none ended.
    states: np.ndarray


class Autoreset:
    """Environments of which each starts its next episode by itself, with states and rewards in float32."""

    def __init__(self, envs: VectorEnv) -> None:
        self._envs = envs
        self.n_envs = envs.n_envs

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start every environment's random stream and an episode; return the first states, (n, d) float32."""
        return self._envs.reset(seeds).astype(np.float32)

    def step(self, actions: np.ndarray) -> Step:
        """Do a step of all environments with actions (n, a) in the environment's units."""
        outcome = self._envs.step(actions)
        next_states = states = outcome.states.astype(np.float32)
        ended = np.flatnonzero(outcome.terminated | outcome.truncated)
        if len(ended):
            states = next_states.copy()
            states[ended] = self._envs.restart(ended)
        return Step(next_states, outcome.rewards.astype(np.float32), outcome.terminated, outcome.truncated, states)

    def close(self) -> None:
        """End the environments; twice does no harm."""
        self._envs.close()


def time_limit(env: EnvConfig) -> int:
    """Return the most steps of an episode; refuse what the implementation in numpy was not compared with.

    Raises:
        ConfigError: `env.kwargs` has more than `max_episode_steps`, or the states are a PID policy's.
    """
    others = sorted(env.kwargs.keys() - {"max_episode_steps"})
    if others:
        raise ConfigError(
            f"environments=numpy: {env.id} is compared without arguments, but env.kwargs has "
            f"{', '.join(others)}; use environments=gymnasium"
        )
    if env.pid is not None:
        raise ConfigError("environments=numpy has no states of PID policies; use environments=gymnasium")
    limit: int | None = env.kwargs.get("max_episode_steps") or spec_of(env.id).max_episode_steps
    assert limit is not None  # every environment that was compared has one
    return limit
