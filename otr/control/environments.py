"""Gymnasium environments as episodes need them: each episode depends on its seed alone, and comes to an end."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from otr.core.arrays import FloatArray

Make = Callable[[], gym.Env[Any, Any]]

INTERFACE = (
    "In gymnasium, reset(seed=..., options=...) returns (observation, info), and step(action) returns "
    "(observation, reward, terminated, truncated, info); gymnasium.utils.env_checker.check_env checks all of that"
)

# Environments whose episodes depend on those before, with the reason (docs/decisions/episodes-and-seeds.md)
_ONE_WORLD = "makes its b2World once, in __init__, which keeps what the contact solver warm-starts from and its order"
NOT_AFRESH = {"BipedalWalker-v3": _ONE_WORLD, "BipedalWalkerHardcore-v3": _ONE_WORLD}


class MadeAnew(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that is made anew for every `reset(seed=...)`: an episode then depends on its seed alone.

    `reset()` without a seed continues in the environment that is there, as training does.
    """

    def __init__(self, make: Make) -> None:
        super().__init__(make())
        self._make, self._is_new = make, True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None and not self._is_new:
            self.env.close()
            self.env = self._make()
        self._is_new = False
        return self.env.reset(seed=seed, options=options)


def depends_on_past(make: Make, n_steps: int = 100) -> bool:
    """Return whether an environment's episodes depend on those that it played before.

    Episodes of at most `n_steps` random steps are compared bit for bit: of seeds 0, 1, 0, 1 in one environment, and of
    0 and 1 in new ones. False where new environments differ, too, or one fails: making it anew is no remedy there.
    """
    try:
        first, second, again, second_again = _short_episodes(make(), (0, 1, 0, 1), n_steps)
        ((anew,), (second_anew,)) = (_short_episodes(make(), (seed,), n_steps) for seed in (0, 1))
    except Exception:  # foreign code can fail in any way; whoever plays in it says so
        return False
    is_same = all(map(_equal, (again, second, second_again), (first, second_anew, second_anew)))
    return not is_same and _equal(anew, first)


def playable(env: Any) -> tuple[Make, bool]:
    """Return a maker of environments whose episodes depend on their seeds alone, and whether it makes several.

    Args:
        env: an id, a function that makes a new environment each time, or an environment, which is played one episode
            after another and left open.

    Raises:
        TypeError: it is none of these.
        ValueError: an environment's episodes depend on those before, and it cannot be made anew.
    """
    if isinstance(env, gym.Env):
        return _of_one(env)
    if isinstance(env, str):
        make: Make = functools.partial(gym.make, env, disable_env_checker=True)  # which costs time at every step
    elif callable(env):
        make = env
    else:
        raise TypeError(
            f"env is a {type(env).__name__}, expected an environment, the id of one, or a function that makes one"
        )
    one = make()
    name = _name(one)
    is_known = _is_gymnasiums(one)
    one.close()
    if name in NOT_AFRESH or (not is_known and depends_on_past(make)):
        if name not in NOT_AFRESH:
            warnings.warn(
                f"{name}: its episodes depend on those that it played before; it is made anew for each", stacklevel=4
            )
        return functools.partial(MadeAnew, make), True
    return make, True


def _of_one(env: gym.Env[Any, Any]) -> tuple[Make, bool]:
    """Return `playable` of an environment."""
    if env.spec is not None and env.spec.id in NOT_AFRESH and _is_gymnasiums(env):
        return functools.partial(MadeAnew, functools.partial(gym.make, env.spec)), True
    if _is_gymnasiums(env) or _repeats(env):
        return lambda: _LeftOpen(env), False
    raise ValueError(
        f"the episodes of {env} depend on those that it played before, so a seed does not decide one: give a function "
        "that makes the environment, which is then called for every episode, or let reset(seed=...) start afresh"
    )


def require_limit(env: gym.Env[Any, Any], max_steps: int | None) -> None:
    """Raise ValueError where an episode may never end: the environment has no time limit, and none is given."""
    if max_steps is not None or (env.spec is not None and env.spec.max_episode_steps is not None):
        return
    inner: Any = env
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, gym.wrappers.TimeLimit):
            return
        inner = inner.env
    raise ValueError(
        f"{_name(env)}: episodes have no limit, so one may never end; give one as max_steps=1000, or where the "
        "environment is registered"
    )


def start(env: gym.Env[Any, Any], seed: int) -> FloatArray:
    """Start an episode and return its first state (d,) float64; ValueError where the interface is another one."""
    try:
        observation, _ = env.reset(seed=seed)
    except (TypeError, ValueError) as error:
        raise ValueError(f"reset(seed={seed}) fails: {type(error).__name__}: {error}. {INTERFACE}") from error
    return state_of(observation)


def step(env: gym.Env[Any, Any], action: Any) -> tuple[FloatArray, float, bool, bool]:
    """Return state (d,), reward, terminated and truncated; ValueError where the interface is another one."""
    answer = env.step(action)
    try:
        observation, reward, terminated, truncated, _ = answer
        return state_of(observation), float(reward), bool(terminated), bool(truncated)
    except (TypeError, ValueError) as error:
        raise ValueError(f"step(action) returns {_shown(answer)}: {error}. {INTERFACE}") from error


def state_of(observation: Any) -> FloatArray:
    """Return an observation as a vector (d,) float64, a copy: an environment may write into its own."""
    return np.array(observation, dtype=np.float64).ravel()


def _name(env: gym.Env[Any, Any]) -> str:
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


class _LeftOpen(gym.Wrapper[Any, Any, Any, Any]):
    """A caller's environment, which stays open."""

    def close(self) -> None:
        """Leave the environment as it is."""


def _is_gymnasiums(env: gym.Env[Any, Any]) -> bool:
    """Return whether an environment and its wrappers are gymnasium's, whose exceptions NOT_AFRESH names."""
    while isinstance(env, gym.Wrapper) and type(env).__module__.startswith("gymnasium."):
        env = env.env
    return type(env).__module__.startswith("gymnasium.envs.")


def _repeats(env: gym.Env[Any, Any]) -> bool:
    try:
        first, second, again, second_again = _short_episodes(env, (0, 1, 0, 1), 100, close=False)
    except Exception:  # as above
        return True
    return _equal(first, again) and _equal(second, second_again)


def _short_episodes(
    env: gym.Env[Any, Any], seeds: tuple[int, ...], n_steps: int, *, close: bool = True
) -> list[FloatArray]:
    """Return states and rewards of short episodes with random actions, one array a seed."""
    played = []
    for seed in seeds:
        seen = [start(env, seed)]
        env.action_space.seed(seed)
        for _ in range(n_steps):
            state, reward, terminated, truncated = step(env, env.action_space.sample())
            seen += [state, np.array([reward])]
            if terminated or truncated:
                break
        played.append(np.concatenate(seen))
    if close:
        env.close()
    return played


def _equal(first: FloatArray, second: FloatArray) -> bool:
    return np.array_equal(first, second, equal_nan=True)


def _shown(answer: Any) -> str:
    if not isinstance(answer, tuple):
        return f"a {type(answer).__name__}"
    return f"{len(answer)} values" if len(answer) != 5 else f"the reward {answer[1]!r}"
