"""Episodes of a deterministic policy in a run's environment, in several processes if that is worth it.

An episode depends on its seed and nothing else, so the order and the number of processes change the time alone, not the
result.
"""

import multiprocessing
import os
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

from otr.control.rollout import Policy as Policy
from otr.control.rollout import Rollout as Rollout
from otr.control.rollout import play_episodes
from pipelines.config.env import EnvConfig
from pipelines.play.environments import episode_limit, make_env

STEPS_WORTH_A_PROCESS = 20_000  # below this a second process costs more time to start than it saves


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
    n_steps = n_episodes * episode_limit(env)
    return max(1, min(available_cores(), n_episodes, n_steps // STEPS_WORTH_A_PROCESS))


def _play(policy: Policy, env: EnvConfig, seeds: list[int], keep_states: bool) -> Rollout:
    return play_episodes(partial(make_env, env), policy, seeds, keep_steps=keep_states)


def _interleave(parts: list[Rollout]) -> Rollout:
    """Put together the results of workers, of which worker w played every n-th episode from the w-th on."""
    n = sum(len(part.seeds) for part in parts)
    order = np.argsort(np.concatenate([np.arange(worker, n, len(parts)) for worker in range(len(parts))]))
    names = ("seeds", "returns", "lengths", "terminated", "truncated")
    merged = {name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names}
    for name in ("states", "actions"):
        pieces = [piece for part in parts for piece in np.split(getattr(part, name), np.cumsum(part.lengths)[:-1])]
        merged[name] = np.concatenate([pieces[i] for i in order])
    return Rollout(**merged)
