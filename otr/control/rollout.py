"""Episodes of a deterministic policy in a gymnasium environment, side by side: one batched prediction a step.

Episode i starts from `reset(seed=seeds[i])` and depends on nothing else.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.control.answers import answer_reader
from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.extras import naming_the_extra

if TYPE_CHECKING:
    import gymnasium as gym

Policy = Callable[[FloatArray], NDArray[Any]]  # states (n, d) -> actions (n, a), or labels (n,)

_SIDE_BY_SIDE = 32
_N_EPISODES = 100
# Where the seeds of `rollout` begin, and what they stay below; those below 2**20 are for reports.
_SEEDS = (2**20, 2**31)


@dataclass(frozen=True, eq=False)
class Rollout:
    """What n episodes came to, in the order of their seeds.

    Attributes:
        seeds, returns, lengths: (n,) each; a return is the undiscounted sum of rewards.
        terminated, truncated: (n,) bool, how each episode ended.
        states: (sum of lengths, d) float64, the states acted on, episode after episode; without rows where not kept.
        actions: (sum of lengths, a), or (sum of lengths,) labels, as the environment was given them; likewise.
    """

    seeds: IntArray
    returns: FloatArray
    lengths: IntArray
    terminated: BoolArray
    truncated: BoolArray
    states: FloatArray
    actions: NDArray[Any]

    @property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return float(self.returns.mean())

    @property
    def std_return(self) -> float:
        """Standard deviation of the returns, over n."""
        return float(self.returns.std())

    def __repr__(self) -> str:
        return (
            f"Rollout(return {self.mean_return:.4g} ± {self.std_return:.4g} over {len(self.returns)} episodes, "
            f"{int(self.lengths.sum()):,} steps)"
        )


@naming_the_extra("otr.rollout")
def rollout(
    env: str | gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]],
    policy: Any,
    n_episodes: int | None = None,
    seed: int = 0,
    *,
    seeds: Sequence[int] | None = None,
    max_steps: int | None = None,
) -> Rollout:
    """Play episodes and keep the states and actions of every step, to prune or to learn from.

    An episode depends on its seed alone. Environments whose episodes do not are made anew for each (gymnasium's
    BipedalWalker, and others that are seen to depend on earlier episodes, of which a warning says so).

    Args:
        env: the id of a registered environment, ``"module:Id"`` too; a function that makes a new one each time, of
            which several are stepped side by side; or an environment, which is stepped alone and left open.
            Observations are a Box, read as vectors (d,); actions a Box or Discrete.
        policy: a tree, a network, or anything with ``predict(X)``, or a function, from states (n, d) float64 to
            actions (n, a) or labels (n,). Actions are rounded to the action space's own type, and not clipped;
            whole numbers that this type cannot hold are an error.
        n_episodes: at least 1; 100 without `seeds`.
        seed: of the episodes' own seeds, which are drawn from 2**20 upwards: never those that `evaluate` plays by
            default.
        seeds: of the episodes, one each, in place of drawn ones.
        max_steps: of an episode, which is truncated there, at least 1; None for the environment's own limit alone.

    Raises:
        ValueError: spaces of other kinds, answers that are not one action of the environment for each state, an
            environment without a limit where `max_steps` is None, or one with another interface than gymnasium's.
        MissingExtraError: gymnasium is not installed.
    """
    if seeds is None:
        n = _checked(n_episodes)
        start = int(np.random.default_rng(seed).integers(_SEEDS[0], _SEEDS[1] - n))
        seeds = range(start, start + n)
    return _play(env, policy, n_episodes, seeds, max_steps, keep_steps=True)


@naming_the_extra("otr.evaluate")
def evaluate(
    env: str | gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]],
    policy: Any,
    seeds: Sequence[int] | None = None,
    *,
    n_episodes: int | None = None,
    max_steps: int | None = None,
) -> Rollout:
    """Play one episode a seed, ``reset(seed=...)``, and return what came of them, without states and actions.

    Policies that are compared play the same episodes: of the seeds 0 to `n_episodes` - 1 unless `seeds` are given.
    Arguments and errors are those of `rollout`.
    """
    seeds = range(_checked(n_episodes)) if seeds is None else seeds
    return _play(env, policy, n_episodes, seeds, max_steps, keep_steps=False)


def _checked(n_episodes: int | None) -> int:
    if n_episodes is not None and n_episodes < 1:
        raise ValueError(f"n_episodes is {n_episodes}, expected 1 or more")
    return _N_EPISODES if n_episodes is None else n_episodes


def _play(
    env: Any, policy: Any, n_episodes: int | None, seeds: Sequence[int], max_steps: int | None, *, keep_steps: bool
) -> Rollout:
    from otr.control.environments import playable

    if n_episodes not in (None, len(seeds)):
        raise ValueError(f"n_episodes is {n_episodes}, and there are {len(seeds)} seeds; give one of the two")
    predict = _function(policy)
    make, makes_several = playable(env)
    n_envs = _SIDE_BY_SIDE if makes_several else 1
    return play_episodes(make, predict, seeds, keep_steps=keep_steps, max_steps=max_steps, n_envs=n_envs)


def play_episodes(
    make_env: Callable[[], gym.Env[Any, Any]],
    policy: Policy,
    seeds: Sequence[int],
    *,
    keep_steps: bool = False,
    max_steps: int | None = None,
    n_envs: int = _SIDE_BY_SIDE,
) -> Rollout:
    """Step some environments side by side, one episode a seed; an environment whose episode ends takes the next seed.

    States and actions are kept with `keep_steps`; `n_envs` is how many environments are made at most; `rollout`
    documents the rest.
    """
    from otr.control.environments import require_limit, start, step

    n = len(seeds)
    if n == 0:
        raise ValueError("there are no seeds; give one for each episode")
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}, expected 1 or more")
    envs = [make_env() for _ in range(min(n_envs, n))]
    returns, lengths = np.zeros(n), np.zeros(n, dtype=np.int64)
    terminated, truncated = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    visited: list[list[FloatArray]] = [[] for _ in seeds]
    done: list[list[Any]] = [[] for _ in seeds]
    episode = list(range(len(envs)))  # the episode that each environment plays
    waiting = len(envs)  # the next episode to start
    limit = math.inf if max_steps is None else max_steps
    try:
        if len({id(env) for env in envs}) < len(envs):
            raise ValueError(
                "env made the same environment twice, expected a new one each time: they are stepped together"
            )
        n_inputs, to_env, no_actions = answer_reader(envs[0])
        require_limit(envs[0], max_steps)
        states = [start(env, int(seeds[i])) for i, env in enumerate(envs)]
        while envs:
            batch = np.array(states)
            _require_finite(batch, episode, seeds, lengths)
            actions = to_env(policy(batch), len(batch))
            for slot in range(len(envs) - 1, -1, -1):  # backwards, so that a finished slot can be removed
                env, i = envs[slot], episode[slot]
                if keep_steps:
                    visited[i].append(states[slot])
                    done[i].append(copy.copy(actions[slot]))  # the environment may change it in place
                states[slot], reward, terminal, timeout = step(env, actions[slot])
                returns[i] += reward
                lengths[i] += 1
                if terminal or timeout or lengths[i] >= limit:
                    if not math.isfinite(returns[i]):
                        raise ValueError(f"the rewards of the episode of seed {seeds[i]} add up to {returns[i]}")
                    terminated[i], truncated[i] = terminal, timeout or not terminal
                    if waiting == n:
                        env.close()
                        del envs[slot], episode[slot], states[slot]
                        continue
                    episode[slot], waiting = waiting, waiting + 1
                    states[slot] = start(env, int(seeds[episode[slot]]))
    finally:
        for env in envs:
            env.close()
    kept = np.array([state for one in visited for state in one]).reshape(-1, n_inputs)
    taken = np.array([action for one in done for action in one] or no_actions, dtype=no_actions.dtype)
    return Rollout(np.array(seeds), returns, lengths, terminated, truncated, kept, taken)


def _require_finite(states: FloatArray, episode: Sequence[int], seeds: Sequence[int], lengths: IntArray) -> None:
    """Raise ValueError where one of the states (n, d) is not finite; `episode` (n,) says whose each is."""
    if not np.isfinite(states).all():
        slot = int((~np.isfinite(states).all(axis=1)).argmax())
        i = episode[slot]
        raise ValueError(
            f"the observation of the episode of seed {seeds[i]} at step {lengths[i]} is not finite: "
            f"{states[slot].tolist()}"
        )


def _function(policy: Any) -> Policy:
    predict = getattr(policy, "predict", policy)
    if not callable(predict):
        raise TypeError(
            f"policy is a {type(policy).__name__}, expected a tree, a network, anything with predict(X), or a function"
        )
    return predict  # type: ignore[no-any-return]
