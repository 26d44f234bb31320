"""Episodes of deterministic policies, side by side: one batched prediction a step.

Episode i starts from `reset(seed=seeds[i])` and depends on nothing else. Whatever plays episodes, here and in
`pipelines`, does so by `play_side_by_side`: one policy or many, in environments of gymnasium's or as arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.extras import naming_the_extra

if TYPE_CHECKING:
    import gymnasium as gym

    from otr.control.environments import VectorEnv

Policy = Callable[[FloatArray], NDArray[Any]]  # states (n, d) -> actions (n, a), or labels (n,)
EpisodePolicy = Callable[[FloatArray, IntArray], NDArray[Any]]  # the same of states and the episodes (n,) they are of

SIDE_BY_SIDE = 32  # environments; more cost memory and are no faster
_N_EPISODES = 100
# Where the seeds of `rollout` begin, and what they stay below; those below 2**20 are for reports.
_SEEDS = (2**20, 2**31)


@dataclass(frozen=True, eq=False)
class Rollout:
    """The results of n episodes, in the order of their seeds.

    Attributes:
        seeds, returns, lengths: (n,) each; a return is the undiscounted sum of rewards.
        terminated, truncated: (n,) bool, how each episode ended.
        states: (sum of lengths, d) float64, the states acted on, episode after episode; without rows where not kept.
        actions: (sum of lengths, a), or (sum of lengths,) labels, as the environment was given them; likewise.
        feature_names: of a state's numbers, from the keys of dictionaries; None where there are none.

    Examples:
        >>> tree = otr.parse_program("if angle + rate <= 0: 0 else: 1", ["x", "v", "angle", "rate"], labels=True)
        >>> played = otr.rollout("CartPole-v1", tree, n_episodes=5, max_steps=10)
        >>> played
        Rollout(return 10 ± 0 over 5 episodes, 50 steps)
        >>> played.states.shape, played.actions.shape
        ((50, 4), (50,))
    """

    seeds: IntArray
    returns: FloatArray
    lengths: IntArray
    terminated: BoolArray
    truncated: BoolArray
    states: FloatArray
    actions: NDArray[Any]
    feature_names: list[str] | None = None

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

    An episode depends on its seed alone. Environments whose episodes do not are recreated for each (gymnasium's
    BipedalWalker, and others that are seen to depend on earlier episodes, of which a warning says so).

    Args:
        env: the id of a registered environment, ``"module:Id"`` too; a function that makes a new one each time, of
            which several are stepped side by side; or an environment, which is stepped alone and left open.
            Observations are vectors (d,): dictionaries, labels and arrays are flattened as gymnasium's
            FlattenObservation does. Actions are a Box or Discrete, whose labels count from 0 here.
        policy: a tree, a network, or anything with ``predict(X)``, or a function, from states (n, d) float64 to
            actions (n, a) or labels (n,); where its head is Identity, the label is the largest output's. Actions are
            rounded to the action space's own type, and not clipped; whole numbers that this type cannot hold are an
            error.
        n_episodes: at least 1; 100 without `seeds`.
        seed: of the episodes' own seeds, which are drawn from 2**20 upwards: never those that `evaluate` plays by
            default.
        seeds: of the episodes, one each, in place of drawn ones.
        max_steps: of an episode, which is truncated there, at least 1; None for the environment's own limit alone.

    Raises:
        ValueError: spaces of other kinds, answers that are not one action of the environment for each state, an
            environment without a limit where `max_steps` is None, or one with another interface than gymnasium's.
        MissingExtraError: gymnasium is not installed.

    Examples:
        >>> tree = otr.parse_program("if angle + rate <= 0: 0 else: 1", ["x", "v", "angle", "rate"], labels=True)
        >>> played = otr.rollout("CartPole-v1", tree, n_episodes=2)
        >>> played.states.shape == (played.lengths.sum(), 4)
        True
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
    """Play one episode a seed, ``reset(seed=...)``, and return their results, without states and actions.

    Policies that are compared play the same episodes: of the seeds 0 to `n_episodes` - 1 unless `seeds` are given.
    Arguments and errors are those of `rollout`.

    Examples:
        >>> tree = otr.parse_program("if angle + rate <= 0: 0 else: 1", ["x", "v", "angle", "rate"], labels=True)
        >>> otr.evaluate("CartPole-v1", tree, n_episodes=2).mean_return > 100
        True
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
    from otr.control.environments import GymnasiumVectorEnv, playable, require_limit
    from otr.control.spaces import deciding, keyed_names

    if n_episodes not in (None, len(seeds)):
        raise ValueError(f"n_episodes is {n_episodes}, and there are {len(seeds)} seeds; give one of the two")
    given = _function(policy)
    make, makes_several = playable(env)
    n_envs = SIDE_BY_SIDE if makes_several else 1
    envs = GymnasiumVectorEnv(make)
    with closing(envs) if makes_several else nullcontext():
        require_limit(envs.first, max_steps)
        predict = deciding(policy, given, envs.first)
        played = play_side_by_side(
            envs, lambda states, _: predict(states), seeds, n_envs=n_envs, max_steps=max_steps, keep_steps=keep_steps
        )
        return replace(played, feature_names=keyed_names(envs.first) or None)


def play_side_by_side(
    envs: VectorEnv,
    policy: EpisodePolicy,
    seeds: Sequence[int],
    *,
    n_envs: int | None = None,
    max_steps: int | None = None,
    alive_bonus: float = 0.0,
    keep_steps: bool = False,
    sort_steps: bool = True,
) -> Rollout:
    """Step some environments side by side, one episode a seed; an environment whose episode ends takes the next seed.

    Args:
        envs: play the episodes, and are left open.
        policy: answers the states of the episodes that go on; these are numbered in the order of their seeds.
        seeds: (n,), one for each episode.
        n_envs: how many play at a time, at most; all of them by default.
        max_steps: of an episode, which is truncated there; None for the environments' own limit alone.
        alive_bonus: is taken off every step's reward.
        keep_steps, sort_steps: whether states and actions are kept, and come episode after episode, else as played.

    Raises:
        ValueError: there are no seeds, or states or returns are not finite.
    """
    n = _n_seeds(seeds, max_steps)
    returns, lengths = np.zeros(n), np.zeros(n, dtype=np.int64)
    terminated, truncated = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    kept: list[tuple[IntArray, FloatArray, NDArray[Any]]] = []  # episodes, states and actions of each step
    n_slots = n_started = n if n_envs is None else min(n, n_envs)
    slots = np.arange(n_slots)  # the environments that play
    episodes, states = slots, envs.reset(seeds[:n_slots])  # the episodes that they play
    while len(slots):
        _require_finite(states, episodes, seeds, lengths)
        stepped = envs.step(policy(states, episodes), None if len(slots) == n_slots else slots)
        if keep_steps:
            kept.append((episodes, states, stepped.actions))
        returns[episodes] += stepped.rewards - alive_bonus
        lengths[episodes] += 1
        states, ended = stepped.states, stepped.terminated | stepped.truncated
        if max_steps is not None:
            ended |= lengths[episodes] >= max_steps
        if not ended.any():
            continue
        over = episodes[ended]
        for i in over[~np.isfinite(returns[over])]:
            raise ValueError(f"the rewards of the episode of seed {seeds[i]} add up to {returns[i]}")
        terminated[over] = stepped.terminated[ended]
        truncated[over] = stepped.truncated[ended] | ~terminated[over]
        episodes = episodes.copy()
        # Backwards: batches, and with them the last bits of answers, are those of committed runs.
        for i, started in zip(np.flatnonzero(ended)[::-1], range(n_started, n), strict=False):
            states[i] = envs.reset([seeds[started]], slots[[i]])[0]
            episodes[i], ended[i], n_started = started, False, started + 1
        slots, episodes, states = slots[~ended], episodes[~ended], states[~ended]
    steps = zip(*(kept or [(episodes, states, stepped.actions[:0])]), strict=True)
    played, visited, actions = (np.concatenate(parts) for parts in steps)
    order = np.argsort(played, kind="stable") if sort_steps else slice(None)
    return Rollout(np.array(seeds), returns, lengths, terminated, truncated, visited[order], actions[order])


def _n_seeds(seeds: Sequence[int], max_steps: int | None) -> int:
    if len(seeds) == 0:
        raise ValueError("there are no seeds; give one for each episode")
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}, expected 1 or more")
    return len(seeds)


def _require_finite(states: FloatArray, episodes: IntArray, seeds: Sequence[int], lengths: IntArray) -> None:
    """Raise ValueError where one of the states (n, d) of these episodes is not finite."""
    if not np.isfinite(states).all():
        row = int((~np.isfinite(states).all(axis=1)).argmax())
        i = episodes[row]
        raise ValueError(
            f"the observation of the episode of seed {seeds[i]} at step {lengths[i]} is not finite: "
            f"{states[row].tolist()}"
        )


def _function(policy: Any) -> Policy:
    predict = getattr(policy, "predict", policy)
    if not callable(predict):
        raise TypeError(
            f"policy is a {type(policy).__name__}, expected a tree, a network, anything with predict(X), or a function"
        )
    return predict  # type: ignore[no-any-return]
