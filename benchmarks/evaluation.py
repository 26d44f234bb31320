"""Evaluation: episodes of Hopper by `pipelines.play.episodes`, against Stable-Baselines3's `evaluate_policy`.

Both play 100 episodes of the same policy on the same environment, and are compared in environment steps a second, since
the two draw other starts and so other lengths. The policy is the committed one of depth 6 where there is one, else
`STANDING`. The peer plays as its documentation shows, one environment in a Monitor.

Targets: at least 2 times the peer on one core, by CPU time; at least 3.5 times on two, by wall clock, which includes
the start of the worker processes and suffers from whatever else the machine does. Their CPU time shows what the two
would do undisturbed, in an entry without a target.
"""

import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import otr
from benchmarks.measure import Entry
from benchmarks.peers import HOPPER, sac_with_actor
from pipelines.engine.store import exists
from pipelines.play.actor_files import load_actor
from pipelines.play.environments import make_env
from pipelines.play.episodes import play_seeds

COMMITTED = Path("results/runs/hopper/otr/depth-6/quick/seed-0/train")

# tanh(K x + k) keeps Hopper-v4 upright for whole episodes; found by random search over gains of one decimal.
STANDING_GAINS = (
    (-0.7, -0.6, -3.0, -0.9, 1.7, 2.1, 3.5, 0.0, -2.1, -1.8, -2.7),
    (-0.6, -2.0, 0.7, 0.7, -0.2, -1.5, -0.8, 0.3, -3.8, -3.1, 3.8),
    (0.5, -2.9, -0.3, -0.9, 2.0, -4.3, -1.6, 0.7, 1.2, -0.1, -1.0),
)
STANDING_OFFSETS = (2.0, 0.7, -0.9)


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick plays 10 episodes, in one round."""
    n_episodes, rounds = (10, 1) if quick else (100, 3)
    network, policy = hopper_policy()
    tree = otr.map_network(network)
    model = sac_with_actor(network)
    env = Monitor(make_env(HOPPER))
    seeds = range(1000, 1000 + n_episodes)

    def ours(n_workers: int) -> int:
        return int(play_seeds(tree.predict, HOPPER, seeds, n_workers=n_workers).lengths.sum())

    def theirs() -> int:
        _, lengths = evaluate_policy(model, env, n_eval_episodes=n_episodes, return_episode_rewards=True)
        return int(np.sum(lengths))

    measured = []
    for i in range(rounds):
        one, peer, two = speeds(lambda: ours(1)), speeds(theirs), speeds(lambda: ours(2))
        measured.append((one.process, peer.process, two.wall, peer.wall, 2 * two.workers))
        print(
            f"evaluation: round {i + 1} of {rounds}, {one.process:,.0f} against {peer.process:,.0f} steps/s", flush=True
        )
    one_core, peer_process, two_cores, peer_wall, undisturbed = np.max(measured, axis=0).tolist()
    name, peer_name, unit = f"{n_episodes} episodes of Hopper, {policy}", "evaluate_policy", "steps/s"
    return [
        Entry(f"{name}: one core", one_core, unit, peer_name, peer_process, "ratio >= 2"),
        Entry(f"{name}: two cores", two_cores, unit, peer_name, peer_wall, "ratio >= 3.5", clock="wall"),
        Entry(f"{name}: two cores by the workers' CPU time", undisturbed, unit, peer_name, peer_process),
    ]


def hopper_policy() -> tuple[otr.ReluNetwork, str]:
    """Return an actor of six neurons whose episodes are long, and what to call it."""
    if exists(COMMITTED / "actor.json"):
        return load_actor(COMMITTED), "trained policy"
    return standing_policy(), "standing policy"


def standing_policy() -> otr.ReluNetwork:
    """Return K x + k as a network: relu(K x + k) - relu(-K x - k)."""
    K, k = np.array(STANDING_GAINS), np.array(STANDING_OFFSETS)
    plus_minus = np.hstack((np.eye(3), -np.eye(3)))
    weights, biases = [np.vstack((K, -K)), plus_minus], [np.concatenate((k, -k)), np.zeros(3)]
    return otr.ReluNetwork(weights, biases, head=otr.TanhBox(-np.ones(3), np.ones(3)))


class Speeds(NamedTuple):
    """Steps per second of wall clock, of this process's CPU time, and of its worker processes' CPU time together."""

    wall: float
    process: float
    workers: float


def speeds(play: Callable[[], int]) -> Speeds:
    """Return the environment steps that `play` does per second, by three clocks; infinite without workers."""
    before = np.array(_clocks())
    n_steps = play()
    spent = np.array(_clocks()) - before
    return Speeds(*(n_steps / seconds if seconds else np.inf for seconds in spent.tolist()))


def _clocks() -> tuple[float, float, float]:
    workers = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter(), time.process_time(), workers.ru_utime + workers.ru_stime
