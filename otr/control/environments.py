"""Gymnasium environments as episodes need them: each episode depends on its seed alone, and comes to an end."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from otr.control.spaces import answer_reader, flattened
from otr.core.arrays import BoolArray, FloatArray, IntArray

Make = Callable[[], gym.Env[Any, Any]]

INTERFACE = (
    "In gymnasium, reset(seed=..., options=...) returns (observation, info), and step(action) returns "
    "(observation, reward, terminated, truncated, info); gymnasium.utils.env_checker.check_env checks all of that"
)

# Environments whose episodes depend on those before, with the reason (docs/decisions/episodes-and-seeds.md)
_ONE_WORLD = "makes its b2World once, in __init__, which keeps what the contact solver warm-starts from and its order"
NOT_AFRESH = {"BipedalWalker-v3": _ONE_WORLD, "BipedalWalkerHardcore-v3": _ONE_WORLD}


class Stepped(NamedTuple):
    """The result of one step of k environments; the arrays belong to the caller."""

    states: FloatArray  # (k, d); where an episode ended, its last state
    rewards: FloatArray  # (k,)
    terminated: BoolArray  # (k,), the episode ended in a terminal state
    truncated: BoolArray  # (k,), the time limit was reached; both may be true, as in gymnasium
    actions: NDArray[Any]  # (k, a), or (k,) labels, as the environments were given them


class VectorEnv(Protocol):
    """Environments of one kind, side by side; each depends on its seed and its actions, not on how many there are.

    An environment whose episode has ended is not stepped again until its next episode was started.
    """

    def reset(self, seeds: Sequence[int] | None, envs: IntArray | None = None) -> FloatArray:
        """Start an episode in environments `envs` (k,), and return their first states (k, d).

        `seeds` (k,) from 0 to 2**32 - 1 restart their random streams; None goes on in them, as gymnasium's reset()
        does. Without `envs` these are the first k, which are all that play from here on.
        """
        ...

    def step(self, actions: NDArray[Any], envs: IntArray | None = None) -> Stepped:
        """Do a step of environments `envs` (k,), or of all that play, with actions (k, a) or labels (k,)."""
        ...

    def close(self) -> None:
        """End the environments; twice does no harm."""
        ...


class GymnasiumVectorEnv:
    """Gymnasium environments one after the other in this process (`VectorEnv`), made when they are first started.

    A plain loop: `SyncVectorEnv` takes 7 to 10 % longer on ten hoppers, and cannot step some of its environments.

    Attributes:
        first: the first environment.
    """

    def __init__(self, make: Make, *, reads_answers: bool = True) -> None:
        """Make the first environment; ValueError where observations are no Box, or actions neither a Box nor labels.

        With `reads_answers` actions are checked and rounded to the action space's own type (`answer_reader`); else the
        environments get them as they are.
        """
        self.first = make()
        self._make, self._envs, self._n_playing = make, [self.first], 0
        self._read = answer_reader(self.first)
        self._reads_answers, self._discrete = reads_answers, isinstance(self.first.action_space, gym.spaces.Discrete)
        self._shape = self.first.observation_space.shape or ()
        self._n_inputs = math.prod(self._shape)

    def reset(self, seeds: Sequence[int] | None, envs: IntArray | None = None) -> FloatArray:
        given = [None] * (self._n_playing if envs is None else len(envs)) if seeds is None else list(seeds)
        chosen = list(range(len(given))) if envs is None else envs.tolist()
        self._n_playing = len(given) if envs is None else self._n_playing
        while len(self._envs) <= max(chosen):
            self._envs.append(self._make())
            if any(self._envs[-1].unwrapped is env.unwrapped for env in self._envs[:-1]):
                self._envs.pop()
                raise ValueError(
                    "env made the same environment twice, expected a new one each time: they are stepped together"
                )
        states = np.empty((len(chosen), self._n_inputs))
        for row, i, seed in zip(states, chosen, given, strict=True):
            try:
                observation, _ = self._envs[i].reset(seed=None if seed is None else int(seed))
            except (TypeError, ValueError) as error:
                raise ValueError(f"reset(seed={seed}) fails: {type(error).__name__}: {error}. {INTERFACE}") from error
            row[:] = np.asarray(observation, dtype=np.float64).ravel()
        return states

    def step(self, actions: NDArray[Any], envs: IntArray | None = None) -> Stepped:
        stepped = self._envs[: self._n_playing] if envs is None else [self._envs[i] for i in envs.tolist()]
        n = len(stepped)
        if self._reads_answers:
            actions = self._read(actions, n)
        states, rewards = np.empty((n, *self._shape)), np.empty(n)
        terminated, truncated = np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.bool_)
        # An environment may change an action in place.
        given = actions.tolist() if self._discrete else actions.copy()
        answer: Any = self  # not among what environments return
        try:
            for j, (env, action) in enumerate(zip(stepped, given, strict=True)):
                answer = self
                answer = env.step(action)
                states[j], rewards[j], terminated[j], truncated[j], _ = answer
        except (TypeError, ValueError) as error:
            if answer is self and "unpack" not in str(error):  # which a wrapper returns from step
                raise
            if answer is self:
                raise ValueError(f"step(action) fails: {type(error).__name__}: {error}. {INTERFACE}") from error
            raise ValueError(f"step(action) returns {_shown(answer)}: {error}. {INTERFACE}") from error
        return Stepped(states.reshape(n, -1), rewards, terminated, truncated, actions)

    def close(self) -> None:
        while self._envs:
            self._envs.pop().close()


class MadeAnew(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that is recreated for every `reset(seed=...)`: an episode then depends on its seed alone.

    `reset()` without a seed continues in the current environment, as training does.
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
    0 and 1 in new ones. False where new environments differ, too, or one fails: recreating it does not help there.
    """
    try:
        first, second, again, second_again = _short_episodes(make(), (0, 1, 0, 1), n_steps)
        ((new,), (second_new,)) = (_short_episodes(make(), (seed,), n_steps) for seed in (0, 1))
    except Exception:  # foreign code can fail in any way; playing in it reports that
        return False
    is_same = all(map(_equal, (again, second, second_again), (first, second_new, second_new)))
    return not is_same and _equal(new, first)


def playable(env: Any) -> tuple[Make, bool]:
    """Return a maker of environments whose episodes depend on their seeds alone, and whether it makes several.

    What they observe is flattened, and their labels begin at 0.

    Args:
        env: an id, a function that makes a new environment each time, or an environment, which is played one episode
            after another and left open.

    Raises:
        TypeError: it is none of these.
        ValueError: its spaces are none of a policy's, or its episodes depend on those before, and it cannot be
            recreated.
    """
    if isinstance(env, gym.Env):
        make_one, makes_several = _of_one(flattened(env))
        return make_one, makes_several
    if isinstance(env, str):
        inner: Make = functools.partial(gym.make, env, disable_env_checker=True)  # which costs time at every step
    elif callable(env):
        inner = env
    else:
        raise TypeError(
            f"env is a {type(env).__name__}, expected an environment, the id of one, or a function that makes one"
        )

    def make() -> gym.Env[Any, Any]:
        return flattened(inner())

    one = make()
    name = _name(one)
    is_known = _is_gymnasiums(one)
    one.close()
    if name in NOT_AFRESH or (not is_known and depends_on_past(make)):
        if name not in NOT_AFRESH:
            warnings.warn(
                f"{name}: its episodes depend on those that it played before; it is recreated for each", stacklevel=4
            )
        return functools.partial(MadeAnew, make), True
    return make, True


def _of_one(env: gym.Env[Any, Any]) -> tuple[Make, bool]:
    """Return `playable` of an environment."""
    if env.spec is not None and env.spec.id in NOT_AFRESH and _is_gymnasiums(env):
        return functools.partial(MadeAnew, functools.partial(gym.make, env.spec)), True
    if _is_gymnasiums(env) or _repeats(env):
        return lambda: env, False
    raise ValueError(
        f"the episodes of {env} depend on those that it played before, so a seed does not decide one: give a function "
        "that makes the environment, which is then called for every episode, or let reset(seed=...) start afresh"
    )


def limited(make: Make, max_steps: int | None) -> Make:
    """Return a maker of environments that truncate episodes after `max_steps`, where that is given."""
    return make if max_steps is None else lambda: gym.wrappers.TimeLimit(make(), max_steps)


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


def _name(env: gym.Env[Any, Any]) -> str:
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


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
    envs, played = GymnasiumVectorEnv(lambda: env, reads_answers=False), []
    for seed in seeds:
        seen = [envs.reset([seed])[0]]
        env.action_space.seed(seed)
        for _ in range(n_steps):
            stepped = envs.step(np.array([env.action_space.sample()]))
            seen += [stepped.states[0], stepped.rewards]
            if stepped.terminated[0] or stepped.truncated[0]:
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
