"""Episodes of many policies at a time: one batch of arrays, on environments side by side in this process."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import otr
from otr.control.search.policy_stack import stack_policies
from pipelines.config.env import EnvConfig
from pipelines.training.environments.backends import make_vector_env
from pipelines.training.environments.vector_envs import VectorEnv

# Episodes under way at a time; a step of the numpy plants costs the same for hundreds of them.
MOST_AT_ONCE = {"gymnasium": 256, "numpy": 8192}


@dataclass(frozen=True)
class Played:
    """What m episodes of each of k policies came to."""

    returns: np.ndarray  # (k, m), without the alive bonus where that is taken off
    lengths: np.ndarray  # (k, m)
    states: np.ndarray  # (n, d), the states acted on, in no order that means anything; empty unless asked for


class SearchEpisodes:
    """Plays policies of one shape in an environment; an episode depends on its policy and its seed alone."""

    def __init__(self, env: EnvConfig, environments: str, alive_bonus: float = 0.0) -> None:
        """Keep what is played.

        Args:
            env: the environment.
            environments: who computes it, "gymnasium" or "numpy".
            alive_bonus: taken off every step's reward, so that standing still is not what is found first.
        """
        self._env, self._environments, self._alive_bonus = env, environments, alive_bonus
        self._made: dict[int, VectorEnv] = {}  # by the number of environments

    def play(
        self,
        policies: Sequence[otr.ObliqueTree] | Sequence[otr.ReluNetwork],
        seeds: np.ndarray,
        *,
        horizon: int | None = None,
        keep_states: bool = False,
    ) -> Played:
        """Play episode j of policy i from `reset(seed=seeds[i, j])`.

        Args:
            policies: k policies that differ in their numbers alone.
            seeds: (k, m).
            horizon: most steps of an episode; None for the environment's own limit alone.
            keep_states: whether the states are wanted.
        """
        k, m = seeds.shape
        width = max(1, MOST_AT_ONCE[self._environments] // k)
        parts = [
            self._play(policies, seeds[:, start : start + width], horizon, keep_states) for start in range(0, m, width)
        ]
        return Played(
            np.concatenate([part.returns for part in parts], axis=1),
            np.concatenate([part.lengths for part in parts], axis=1),
            np.concatenate([part.states for part in parts]),
        )

    def _play(self, policies: Sequence[Any], seeds: np.ndarray, horizon: int | None, keep_states: bool) -> Played:
        k, m = seeds.shape
        if k * m not in self._made:
            self._made[k * m] = make_vector_env(self._env, k * m, self._environments)
        envs = self._made[k * m]
        stack = stack_policies(policies)
        states = np.asarray(envs.reset(seeds.ravel().tolist()), dtype=np.float64).reshape(k, m, -1)
        live = np.ones((k, m), dtype=bool)  # the episodes that go on, of the policies in the stack
        playing = np.arange(k * m)  # their environments
        returns, lengths = np.zeros((k, m)), np.zeros((k, m), dtype=np.int64)
        visited = []
        for _ in itertools.count() if horizon is None else range(horizon):
            actions = stack.predict(states)
            if keep_states:
                visited.append(states[live])
            outcome = envs.step(actions[live], None if len(playing) == k * m else playing)
            returns.reshape(-1)[playing] += outcome.rewards - self._alive_bonus
            lengths.reshape(-1)[playing] += 1
            states[live] = outcome.states
            ended = outcome.terminated | outcome.truncated
            if ended.any():
                live[live] = ~ended
                playing = playing[~ended]
                if not len(playing):
                    break
                going = np.asarray(live.any(axis=1))
                if going.sum() <= len(live) // 2:  # the others' answers are no longer worked out
                    live, states, stack = live[going], states[going], stack.take(going)
        return Played(returns, lengths, np.concatenate(visited) if visited else np.zeros((0, states.shape[2])))

    def close(self) -> None:
        """End the environments."""
        for envs in self._made.values():
            envs.close()
        self._made.clear()
