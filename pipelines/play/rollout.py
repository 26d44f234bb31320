"""Episodes of a deterministic policy, many at a time: one batched prediction a step, several processes if wanted.

Episode i starts from `reset(seed=seeds[i])` and depends on nothing else, so the order, the number of environments side
by side and the number of processes change the time alone, not the result.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from pipelines.config.env import EnvConfig
from pipelines.play.environments import is_discrete, longest_episode, make_env

Policy = Callable[[np.ndarray], np.ndarray]  # states (n, d) -> actions (n, a), or labels (n,)

ENVS_PER_PROCESS = 32
STEPS_WORTH_A_PROCESS = 20_000  # below this a second process costs more time to start than it saves


@dataclass(frozen=True)
class Rollout:
    """What n episodes came to, in the order of their seeds."""

    seeds: np.ndarray  # (n,) each, as the next four are
    returns: np.ndarray
    lengths: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    # (sum of lengths, d), the states acted on, episode after episode; empty unless they were asked for
    states: np.ndarray


def rollout(
    policy: Policy, env: EnvConfig, seeds: Sequence[int], *, keep_states: bool = False, n_workers: int | None = None
) -> Rollout:
    """Play one episode a seed and return what came of them, with the visited states where these are kept.

    The policy must be picklable where several processes are used. Without `n_workers` there is a process for each core,
    if the episodes are long enough to pay for it.
    """
    n_workers = _n_workers(env, len(seeds)) if n_workers is None else min(n_workers, len(seeds))
    if n_workers == 1:
        return _play(policy, env, list(seeds), keep_states)
    context = multiprocessing.get_context("spawn")
    parts = [list(seeds[worker::n_workers]) for worker in range(n_workers)]
    with ProcessPoolExecutor(n_workers, context) as pool:
        try:
            # Workers inherit the mask: Ctrl-C reaches this process alone, which ends them.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                futures = [pool.submit(_play, policy, env, part, keep_states) for part in parts]
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            return _interleave([future.result() for future in futures])
        except BaseException:  # do not wait for the other workers' episodes
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def _n_workers(env: EnvConfig, n_episodes: int) -> int:
    n_steps = n_episodes * longest_episode(env)
    return max(1, min(available_cores(), n_episodes, n_steps // STEPS_WORTH_A_PROCESS))


def _play(policy: Policy, env_config: EnvConfig, seeds: list[int], keep_states: bool) -> Rollout:
    """Step up to ENVS_PER_PROCESS environments side by side; one that ends takes the next seed."""
    envs = [make_env(env_config) for _ in range(min(ENVS_PER_PROCESS, len(seeds)))]
    to_env = _action_converter(envs[0])
    n = len(seeds)
    returns, lengths = np.zeros(n), np.zeros(n, dtype=np.int64)
    terminated, truncated = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    visited: list[list[np.ndarray]] = [[] for _ in seeds]
    episode = list(range(len(envs)))  # the episode that each environment plays
    states = [np.asarray(env.reset(seed=seeds[i])[0], dtype=np.float64) for i, env in enumerate(envs)]
    waiting = len(envs)  # the next episode to start
    try:
        while envs:
            actions = to_env(policy(np.array(states)))
            for slot in range(len(envs) - 1, -1, -1):  # backwards, so that a finished slot can be removed
                env, i = envs[slot], episode[slot]
                if keep_states:
                    visited[i].append(states[slot])
                state, reward, terminal, timeout, _ = env.step(actions[slot])
                returns[i] += float(reward)
                lengths[i] += 1
                if terminal or timeout:
                    terminated[i], truncated[i] = terminal, timeout
                    if waiting == n:
                        env.close()
                        del envs[slot], episode[slot], states[slot]
                        continue
                    episode[slot], waiting = waiting, waiting + 1
                    state, _ = env.reset(seed=seeds[episode[slot]])
                states[slot] = np.asarray(state, dtype=np.float64)
    finally:
        for env in envs:
            env.close()
    kept = [state for states_of_one in visited for state in states_of_one]
    return Rollout(np.array(seeds), returns, lengths, terminated, truncated, np.array(kept))


def _action_converter(env: gym.Env) -> Callable[[np.ndarray], list[Any]]:
    """Return the function from a batch of answers to what `env.step` takes, one element an environment.

    Continuous actions are rounded to the action space's own type (float32), as a trained policy's are: policies that
    are equal up to the last bits of float64 then play the same episode.
    """
    if is_discrete(env):
        return lambda answers: answers.tolist()
    dtype = env.action_space.dtype
    return lambda answers: list(np.asarray(answers, dtype=dtype))


def _interleave(parts: list[Rollout]) -> Rollout:
    """Put together the results of workers, of which worker w played every n-th episode from the w-th on."""
    n = sum(len(part.seeds) for part in parts)
    order = np.argsort(np.concatenate([np.arange(worker, n, len(parts)) for worker in range(len(parts))]))
    names = ("seeds", "returns", "lengths", "terminated", "truncated")
    merged = {name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names}
    if not len(parts[0].states):
        return Rollout(**merged, states=np.empty((0, 0)))
    pieces = [piece for part in parts for piece in np.split(part.states, np.cumsum(part.lengths)[:-1])]
    return Rollout(**merged, states=np.concatenate([pieces[i] for i in order]))
