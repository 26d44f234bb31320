"""Episodes of deterministic policies in a run's environment: of a policy on some seeds, or of many policies at a time.

All are played by `otr.control.rollout.play_side_by_side`. An episode depends on its policy and its seed and nothing
else, so the order and the number of processes change the time alone, not the result.
"""

import multiprocessing
import os
import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import otr
from otr.control.environments import GymnasiumVectorEnv
from otr.control.rollout import SIDE_BY_SIDE, play_side_by_side
from otr.control.rollout import Policy as Policy
from otr.control.rollout import Rollout as Rollout
from otr.control.search.policy_stack import stack_policies
from pipelines.config.env import EnvConfig
from pipelines.config.stages import EvaluateConfig, PruneConfig, TrainConfig
from pipelines.engine.seeding import episode_seeds, evaluation_seeds
from pipelines.play.classic_control import ClassicControlVectorEnv
from pipelines.play.environments import episode_limit, is_made_anew, make_env
from pipelines.play.vector_envs import fastest_environments, make_vector_env

# Environment steps per second on one core, measured; in numpy with the batches of conf/env
NUMPY_STEPS_PER_S = {"pendulum": 4_000_000.0, "mountaincar": 300_000.0}
STEPS_PER_S = {"lunarlander": 18_000.0, "halfcheetah": 18_000.0, "swimmer": 14_000.0, "ant": 3_500.0}
OTHER_STEPS_PER_S = 8_000.0
SHARE_PLAYED = 0.5  # of an episode's longest length
STEPS_WORTH_A_PROCESS = 20_000  # below this a second process costs more time to start than it saves
# Episodes of many policies under way at a time; a step of the numpy plants costs the same for hundreds of them.
MOST_AT_ONCE = {"gymnasium": 256, "numpy": 8192}


@dataclass(frozen=True)
class PlaysPruning:
    """What a stage has that plays the episodes that a run is pruned with."""

    env: EnvConfig
    n_workers: int | None
    seed: int
    prune: PruneConfig


@dataclass(frozen=True)
class PlaysEvaluation:
    """What a stage has that plays the episodes that are reported."""

    env: EnvConfig
    n_workers: int | None
    evaluate: EvaluateConfig


@dataclass(frozen=True)
class PlaysSelection:
    """What a training has that plays the episodes which decide what of it is kept."""

    env: EnvConfig
    seed: int
    train: TrainConfig


def play_seeds(
    policy: Policy,
    env: EnvConfig,
    seeds: Sequence[int],
    *,
    keep_states: bool = False,
    n_workers: int | None = None,
    environments: str = "gymnasium",
) -> Rollout:
    """Play one episode a seed and return what came of them, with the visited states where these are kept.

    The policy must be picklable where several processes are used. Without `n_workers` there is a process for each core,
    if the episodes are long enough to pay for it. In numpy there is one process, where thousands of starts take a
    second.
    """
    n_workers = _n_workers(env, len(seeds)) if n_workers is None else min(n_workers, len(seeds))
    if n_workers == 1 or environments == "numpy":
        return _play(policy, env, list(seeds), keep_states, environments)
    context = multiprocessing.get_context("spawn")
    parts = [part.tolist() for part in np.array_split(seeds, n_workers)]
    with ProcessPoolExecutor(n_workers, context) as pool:
        try:
            # Workers inherit the mask: Ctrl-C reaches this process alone, which ends them.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                futures = [pool.submit(_play, policy, env, part, keep_states) for part in parts]
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            played = [future.result() for future in futures]
            names = [each.name for each in fields(Rollout) if each.name != "feature_names"]
            arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in played]) for name in names}
            return Rollout(**arrays)
        except BaseException:  # do not wait for the other workers' episodes
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def playing_seconds(env: EnvConfig, n_episodes: int, environments: str = "gymnasium", *, n_steps: int = 0) -> float:
    """Return the likely time of playing episodes and so many steps more on one core."""
    table = NUMPY_STEPS_PER_S if environments == "numpy" else STEPS_PER_S
    return (n_steps + n_episodes * episode_limit(env) * SHARE_PLAYED) / table.get(env.task, OTHER_STEPS_PER_S)


def _n_workers(env: EnvConfig, n_episodes: int) -> int:
    n_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return max(1, min(n_cores, n_episodes, n_episodes * episode_limit(env) // STEPS_WORTH_A_PROCESS))


def _play(
    policy: Policy, env: EnvConfig, seeds: Sequence[int], keep_states: bool, environments: str = "gymnasium"
) -> Rollout:
    is_numpy = environments == "numpy"
    with closing(ClassicControlVectorEnv(env) if is_numpy else GymnasiumVectorEnv(partial(make_env, env))) as envs:
        n_envs = len(seeds) if is_numpy else SIDE_BY_SIDE
        return play_side_by_side(envs, lambda states, _: policy(states), seeds, n_envs=n_envs, keep_steps=keep_states)


def play_pruning(policy: Policy, config: PlaysPruning) -> Rollout:
    """Play the episodes that a run is pruned with, states and actions kept."""
    seeds = episode_seeds(config.seed, "prune", config.prune.n_episodes)
    return play_seeds(policy, config.env, seeds, keep_states=True, n_workers=config.n_workers)


def play_selection(policy: Policy, config: PlaysSelection) -> Rollout:
    """Play the episodes that decide which actor of a training is kept, states and actions kept."""
    seeds = episode_seeds(config.seed, "selection", config.train.n_selection_episodes)
    return play_seeds(policy, config.env, seeds, keep_states=True, n_workers=1)


def play_evaluation(policy: Policy, config: PlaysEvaluation, *, keep_states: bool = False) -> Rollout:
    """Play episode i from `reset(seed=first_seed + i)`, for every policy alike; states and actions if asked for."""
    return play_seeds(
        policy,
        config.env,
        evaluation_seeds(config.evaluate.first_seed, config.evaluate.n_episodes),
        keep_states=keep_states,
        n_workers=config.n_workers,
        environments=fastest_environments(config.env),
    )


def play_each(policies: Mapping[str, Any], config: PlaysEvaluation) -> dict[str, Rollout]:
    """Play the evaluation episodes with each policy, states and actions kept.

    A policy that does what an earlier one did, in every state of that one's episodes, has the same episodes: they are
    not played again. A network, its tree and its pruned tree are most often such policies.
    """
    played: dict[str, Rollout] = {}
    for name, policy in policies.items():
        same = next((each for each in played.values() if _acts_as(policy, each)), None)
        played[name] = same or play_evaluation(policy.predict, config, keep_states=True)
    return played


def _acts_as(policy: Any, played: Rollout) -> bool:
    """Return whether a policy's actions equal those of all episodes, to the last bit that environments receive."""
    return np.array_equal(np.asarray(policy.predict(played.states)).astype(played.actions.dtype), played.actions)


def episodes_version(config: PlaysEvaluation) -> int:
    """Return the version of stages that report evaluation episodes: 2 where each has its own environment."""
    return 2 if is_made_anew(config.env) else 1


def moments(played: Rollout, suffix: str = "") -> dict[str, float]:
    """Return mean and standard deviation of the return over episodes (the sample's, ddof 0), with a suffix each."""
    return {f"return_mean{suffix}": played.mean_return, f"return_std{suffix}": played.std_return}


class Played(NamedTuple):
    """The results of m episodes of each of k policies."""

    returns: np.ndarray  # (k, m), without the alive bonus where that is taken off
    lengths: np.ndarray  # (k, m)
    states: np.ndarray  # (n, d), the states acted on, in no order that means anything; empty unless asked for


class Player:
    """Plays many policies of one shape at a time, as a search does, and counts the environment steps, `n_steps`."""

    def __init__(self, env: EnvConfig, environments: str) -> None:
        """Prepare an environment, which "gymnasium" or "numpy" computes."""
        self._envs, self._at_once = make_vector_env(env, environments), MOST_AT_ONCE[environments]
        self.n_steps = 0

    def play(
        self,
        policies: Sequence[otr.ObliqueTree] | Sequence[otr.ReluNetwork],
        seeds: np.ndarray,
        *,
        horizon: int | None = None,
        alive_bonus: float = 0.0,
        keep_states: bool = False,
    ) -> Played:
        """Play episode j of policy i from `reset(seed=seeds[i, j])`.

        Args:
            policies: k policies that differ in their numbers alone.
            seeds: (k, m).
            horizon: most steps of an episode; None for the environment's own limit alone.
            alive_bonus: taken off every step's reward, so that a search does not find standing still first.
            keep_states: whether the states are wanted.
        """
        k, m = seeds.shape
        width = max(1, self._at_once // k)
        parts = [
            play_side_by_side(
                self._envs,
                _PolicyStack(policies, some.shape[1]),
                some.ravel().tolist(),
                max_steps=horizon,
                alive_bonus=alive_bonus,
                keep_steps=keep_states,
                sort_steps=False,
            )
            for some in (seeds[:, start : start + width] for start in range(0, m, width))
        ]
        both = [(part.returns.reshape(k, -1), part.lengths.reshape(k, -1)) for part in parts]
        returns, lengths = (np.concatenate(each, axis=1) for each in zip(*both, strict=True))
        self.n_steps += int(lengths.sum())
        return Played(returns, lengths, np.concatenate([part.states for part in parts]))

    def returns(self, policies: Sequence[Any], seeds: np.ndarray) -> np.ndarray:
        """Return the returns (k, m) of `play`, as `otr.polish` asks for them."""
        return self.play(policies, seeds).returns

    def close(self) -> None:
        """End the environments."""
        self._envs.close()


class _PolicyStack:
    """k policies as one: policy i answers in the episodes i m to (i + 1) m - 1."""

    def __init__(self, policies: Sequence[Any], m: int) -> None:
        self._stack, self._m = stack_policies(policies), m
        self._row = np.arange(len(policies))  # of each policy in the stack
        self._places = np.arange(0)  # of the episodes that go on, in the batch
        self._batch = np.empty(
            (0, m, 0)
        )  # (policies in the stack, m, d); what is left of ended episodes is answered, too

    def __call__(self, states: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        if len(episodes) != len(self._places):
            self._place(states, episodes)
        self._batch.reshape(-1, states.shape[1])[self._places] = states
        answers = self._stack.predict(self._batch)
        return answers.reshape(-1, *answers.shape[2:])[self._places]

    def _place(self, states: np.ndarray, episodes: np.ndarray) -> None:
        """Find the episodes' places; policies whose episodes have ended leave the stack once they are half of it."""
        policies, starts = episodes // self._m, episodes % self._m
        if not len(self._places):
            self._batch = states.reshape(-1, self._m, states.shape[1]).copy()
        going = np.zeros(len(self._batch), dtype=bool)
        going[self._row[policies]] = True
        if going.sum() <= len(going) // 2:
            self._stack, self._batch = self._stack.take(going), self._batch[going]
            self._row = (np.cumsum(going) - 1)[self._row]
        self._places = self._row[policies] * self._m + starts
