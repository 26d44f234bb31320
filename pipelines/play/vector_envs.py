"""Environments side by side (`otr.control.environments.VectorEnv`) by who computes them; `Autoreset`, for training.

A run of a fleet sees what it would see alone, because an environment does not depend on the number of others.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from otr.control.environments import GymnasiumVectorEnv, VectorEnv
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.classic_control import EQUAL_IDS, ClassicControlVectorEnv
from pipelines.play.spaces import make_training_env


def make_vector_env(env: EnvConfig, environments: str, *, rescale_inputs: bool = False) -> VectorEnv:
    """Return environments in which a policy is trained or searched for, which "gymnasium" or "numpy" computes.

    With `rescale_inputs` gymnasium's states are rescaled from their box to [-1, 1].

    Raises:
        ConfigError: as `check_environments`, or there is no such environment, or no box of states to rescale.
    """
    check_environments(env, environments)
    if environments == "numpy":
        return ClassicControlVectorEnv(env)
    # The environments of conf/env take actions as they are, in float64 from searches: committed searches stay
    # bit for bit. All others, which may require it, get actions of their own space.
    make = partial(make_training_env, env, rescale_inputs=rescale_inputs)
    return GymnasiumVectorEnv(make, reads_answers=not env.has_file)


def check_environments(env: EnvConfig, environments: str) -> None:
    """Raise ConfigError unless `environments` computes this one as gymnasium does."""
    if environments == "gymnasium":
        return
    others = sorted(env.kwargs.keys() - {"max_episode_steps"})
    if env.id not in EQUAL_IDS:
        reason = f"{env.id} is not among those that were compared with gymnasium's ({', '.join(EQUAL_IDS)})"
    elif others:
        reason = f"{env.id} is compared without arguments, but env.kwargs has {', '.join(others)}"
    elif env.pid is not None:
        reason = "there are no states of PID policies"
    else:
        return
    raise ConfigError(f"environments={environments}: {reason}; use environments=gymnasium")


def fastest_environments(env: EnvConfig) -> str:
    """Return "numpy" where that computes an environment as gymnasium does, else "gymnasium"."""
    return "numpy" if env.id in EQUAL_IDS and not env.kwargs and env.pid is None else "gymnasium"


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
