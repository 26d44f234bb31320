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

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.extras import naming_the_extra

if TYPE_CHECKING:
    import gymnasium as gym

Policy = Callable[[FloatArray], NDArray[Any]]  # states (n, d) -> actions (n, a), or labels (n,)

_SIDE_BY_SIDE = 32
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
    env: str | Callable[[], gym.Env[Any, Any]],
    policy: Any,
    n_episodes: int = 100,
    seed: int = 0,
    *,
    max_steps: int | None = None,
) -> Rollout:
    """Play episodes and keep the states and actions of every step, to prune or to learn from.

    The episodes' own seeds are drawn from `seed`, from 2**20 upwards: never those that `evaluate` plays by default.

    Args:
        env: the id of a registered environment, ``"module:Id"`` too, or a function that makes a new one each time.
            Observations are a Box, read as vectors (d,); actions a Box or Discrete.
        policy: a tree, a network, or anything with ``predict(X)``, or a function, from states (n, d) float64 to
            actions (n, a) or labels (n,). Actions are rounded to the action space's own type, and not clipped;
            whole numbers that this type cannot hold are an error.
        n_episodes: at least 1.
        seed: of all of it.
        max_steps: of an episode, which is truncated there, at least 1; None for the environment's own limit alone.

    Raises:
        ValueError: spaces of other kinds, or answers that are not one action of the environment for each state.
        MissingExtraError: gymnasium is not installed.
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes is {n_episodes}, expected 1 or more")
    start = int(np.random.default_rng(seed).integers(_SEEDS[0], _SEEDS[1] - n_episodes))
    seeds = range(start, start + n_episodes)
    return play_episodes(_maker(env), _function(policy), seeds, keep_steps=True, max_steps=max_steps)


@naming_the_extra("otr.evaluate")
def evaluate(
    env: str | Callable[[], gym.Env[Any, Any]],
    policy: Any,
    seeds: Sequence[int] = range(100),
    *,
    max_steps: int | None = None,
) -> Rollout:
    """Play one episode a seed, ``reset(seed=...)``, and return what came of them, without states and actions.

    Policies that are compared play the same episodes. Arguments and errors are those of `rollout`.
    """
    return play_episodes(_maker(env), _function(policy), seeds, max_steps=max_steps)


def play_episodes(
    make_env: Callable[[], gym.Env[Any, Any]],
    policy: Policy,
    seeds: Sequence[int],
    *,
    keep_steps: bool = False,
    max_steps: int | None = None,
) -> Rollout:
    """Step some environments side by side, one episode a seed; an environment whose episode ends takes the next seed.

    States and actions are kept with `keep_steps`; `rollout` documents the rest.
    """
    n = len(seeds)
    if n == 0:
        raise ValueError("there are no seeds; give one for each episode")
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}, expected 1 or more")
    envs = [make_env() for _ in range(min(_SIDE_BY_SIDE, n))]
    returns, lengths = np.zeros(n), np.zeros(n, dtype=np.int64)
    terminated, truncated = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    visited: list[list[FloatArray]] = [[] for _ in seeds]
    done: list[list[Any]] = [[] for _ in seeds]
    episode = list(range(len(envs)))  # the episode that each environment plays
    waiting = len(envs)  # the next episode to start
    limit = math.inf if max_steps is None else max_steps
    try:
        n_inputs, to_env, no_actions = _spaces(envs)
        states = [_state(env.reset(seed=int(seeds[i]))[0]) for i, env in enumerate(envs)]
        while envs:
            batch = np.array(states)
            if not np.isfinite(batch).all():
                slot = int((~np.isfinite(batch).all(axis=1)).argmax())
                i = episode[slot]
                raise ValueError(
                    f"the observation of the episode of seed {seeds[i]} at step {lengths[i]} is not finite: "
                    f"{batch[slot].tolist()}"
                )
            actions = to_env(policy(batch), len(batch))
            for slot in range(len(envs) - 1, -1, -1):  # backwards, so that a finished slot can be removed
                env, i = envs[slot], episode[slot]
                if keep_steps:
                    visited[i].append(states[slot])
                    done[i].append(copy.copy(actions[slot]))  # the environment may change it in place
                observation, reward, terminal, timeout, _ = env.step(actions[slot])
                returns[i] += float(reward)
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
                    observation, _ = env.reset(seed=int(seeds[episode[slot]]))
                states[slot] = _state(observation)
    finally:
        for env in envs:
            env.close()
    kept = np.array([state for one in visited for state in one]).reshape(-1, n_inputs)
    taken = np.array([action for one in done for action in one] or no_actions, dtype=no_actions.dtype)
    return Rollout(np.array(seeds), returns, lengths, terminated, truncated, kept, taken)


def _maker(env: Any) -> Callable[[], gym.Env[Any, Any]]:
    import gymnasium as gym

    if isinstance(env, str):
        return lambda: gym.make(env, disable_env_checker=True)  # it costs time at every step
    if not callable(env):
        raise TypeError(
            f"env is a {type(env).__name__}, expected the id of an environment or a function that makes one, since "
            "several are stepped side by side: lambda: MyEnv(...)"
        )
    return env  # type: ignore[no-any-return]


def _function(policy: Any) -> Policy:
    predict = getattr(policy, "predict", policy)
    if not callable(predict):
        raise TypeError(
            f"policy is a {type(policy).__name__}, expected a tree, a network, anything with predict(X), or a function"
        )
    return predict  # type: ignore[no-any-return]


def _state(observation: Any) -> FloatArray:
    return np.array(observation, dtype=np.float64).ravel()  # a copy, as an environment may go on writing into its own


def _spaces(envs: Sequence[gym.Env[Any, Any]]) -> tuple[int, Callable[[Any, int], Sequence[Any]], NDArray[Any]]:
    """Return the length of a state, the function from the answers to n states to actions, and an array of no actions.

    Continuous actions are rounded to the action space's own type (float32), as a trained policy's are: policies that
    are equal up to the last bits of float64 then play the same episode.
    """
    from gymnasium import spaces

    if len({id(env) for env in envs}) < len(envs):
        raise ValueError("env made the same environment twice, expected a new one each time: they are stepped together")
    seen, space = envs[0].observation_space, envs[0].action_space
    if not isinstance(seen, spaces.Box):
        raise ValueError(
            f"the observations are {seen}, expected a Box; wrap the environment, as in "
            "gymnasium.wrappers.FlattenObservation"
        )
    n_inputs = math.prod(seen.shape)
    if isinstance(space, spaces.Discrete) and space.start == 0:
        n_labels = int(space.n)
        return n_inputs, lambda answers, n: _labels(answers, n, n_labels), np.zeros(0, dtype=np.int64)
    if not isinstance(space, spaces.Box):
        raise ValueError(f"the actions are {space}, expected a Box, or Discrete from 0 on; wrap the environment")
    shape, dtype = space.shape, space.dtype
    return n_inputs, lambda answers, n: _actions(answers, n, shape, dtype), np.zeros((0, *shape), dtype=dtype)


def _labels(answers: Any, n: int, n_labels: int) -> list[int]:
    labels = _array(answers)
    if labels.shape != (n,) or labels.dtype.kind not in "iu" or labels.min() < 0 or labels.max() >= n_labels:
        raise ValueError(
            f"the policy answers {_shown(answers)}, expected labels (n,) from 0 to {n_labels - 1} for n = {n} states"
        )
    return labels.tolist()  # type: ignore[no-any-return]


def _actions(answers: Any, n: int, shape: tuple[int, ...], dtype: Any) -> list[NDArray[Any]]:
    actions, size = _array(answers), math.prod(shape)
    if actions.shape[:1] != (n,) or actions.size != n * size or not np.isfinite(actions).all():
        raise ValueError(
            f"the policy answers {_shown(answers)}, expected finite actions (n, {size}) for n = {n} states"
        )
    rounded = actions
    if np.issubdtype(dtype, np.integer):
        rounded, held = np.rint(actions), np.iinfo(dtype)
        if (rounded < held.min).any() or (rounded > held.max).any():
            raise ValueError(
                f"the policy answers {_shown(answers)}; the actions are of type {dtype}, from {held.min} to {held.max}"
            )
    return list(rounded.astype(dtype).reshape(-1, *shape))


def _array(answers: Any) -> NDArray[Any]:
    if isinstance(answers, tuple):
        raise ValueError(
            f"the policy answers a tuple of {len(answers)}, expected an array of one action a state; of a model of "
            "Stable-Baselines3, give lambda X: model.predict(X, deterministic=True)[0]"
        )
    return np.asarray(answers)


def _shown(answers: Any) -> str:
    array = np.asarray(answers)
    return f"an array of shape {array.shape} and type {array.dtype}, first {array.ravel()[:1].tolist()}"
