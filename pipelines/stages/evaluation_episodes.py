"""The evaluation episodes of a policy: the pendulum and the mountain car in numpy, all others in gymnasium.

The plants in numpy are gymnasium's (`pipelines.training.environments.classic_control` says how exactly), and thousands
of starts take a second there.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from pipelines.config.env import EnvConfig
from pipelines.config.run import RunConfig
from pipelines.engine.seeding import evaluation_seeds
from pipelines.play.environments import is_made_anew
from pipelines.play.rollout import Policy, Rollout, rollout
from pipelines.training.environments.classic_control import EQUAL_IDS, ClassicControlVectorEnv


def play_evaluation_episodes(policy: Policy, config: RunConfig, *, keep_states: bool = False) -> Rollout:
    """Play episode i from `reset(seed=first_seed + i)`, for every policy alike; states and actions if asked for."""
    seeds = evaluation_seeds(config.evaluate.first_seed, config.evaluate.n_episodes)
    if has_numpy_plant(config.env):
        return play_in_numpy(policy, config.env, seeds, keep_states=keep_states)
    return rollout(policy, config.env, seeds, keep_states=keep_states, n_workers=config.n_workers)


def play_each(policies: Mapping[str, Any], config: RunConfig) -> dict[str, Rollout]:
    """Play the evaluation episodes with each policy, states and actions kept.

    A policy that does what an earlier one did, in every state of that one's episodes, has the same episodes: they are
    not played again. A network, its tree and its pruned tree are most often such policies.
    """
    played: dict[str, Rollout] = {}
    for name, policy in policies.items():
        same = next((each for each in played.values() if _acts_as(policy, each)), None)
        played[name] = same or play_evaluation_episodes(policy.predict, config, keep_states=True)
    return played


def _acts_as(policy: Any, played: Rollout) -> bool:
    """Return whether a policy does, to the last bit that environments are given, what was done in all episodes."""
    return np.array_equal(np.asarray(policy.predict(played.states)).astype(played.actions.dtype), played.actions)


def episodes_version(config: RunConfig) -> int:
    """Return the version of stages that report evaluation episodes: 2 where each has an environment of its own."""
    return 2 if is_made_anew(config.env) else 1


def moments(played: Rollout, suffix: str = "") -> dict[str, float]:
    """Return mean and standard deviation of the return over episodes (the sample's, ddof 0), with a suffix each."""
    returns = played.returns
    return {f"return_mean{suffix}": float(returns.mean()), f"return_std{suffix}": float(returns.std())}


def has_numpy_plant(env: EnvConfig) -> bool:
    """Return whether the environment is computed in numpy as gymnasium does."""
    return env.id in EQUAL_IDS and not env.kwargs and env.pid is None


def play_in_numpy(policy: Policy, env: EnvConfig, seeds: list[int], *, keep_states: bool = False) -> Rollout:
    """Play one episode a seed, all of them side by side, and return what `rollout` returns."""
    n = len(seeds)
    envs = ClassicControlVectorEnv(env, n)
    states = np.asarray(envs.reset(seeds), dtype=np.float64)
    returns, lengths = np.zeros(n), np.zeros(n, dtype=np.int64)
    terminated, truncated = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    playing = np.arange(n)
    kept: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # episodes, states and actions of each step
    for step in itertools.count(1):
        actions = np.asarray(policy(states), dtype=np.float32)
        if keep_states:
            kept.append((playing, states, actions))
        outcome = envs.step(actions, playing)
        returns[playing] += outcome.rewards
        lengths[playing] = step
        terminated[playing], truncated[playing] = outcome.terminated, outcome.truncated
        going = ~(outcome.terminated | outcome.truncated)
        playing, states = playing[going], np.asarray(outcome.states[going], dtype=np.float64)
        if not len(playing):
            break
    visited, taken = np.zeros((0, states.shape[1])), np.zeros((0, 1), dtype=np.float32)
    if keep_states:
        order = np.argsort(np.concatenate([episodes for episodes, _, _ in kept]), kind="stable")
        visited, taken = (np.concatenate([each[i] for each in kept])[order] for i in (1, 2))
    return Rollout(np.array(seeds), returns, lengths, terminated, truncated, visited, taken)
