"""Evaluation: episodes of Hopper by `pipelines.rollout` with a tree, against Stable-Baselines3's `evaluate_policy`.

Both play 100 episodes of the same policy on the same environment, and are compared in environment steps a second, since
the two draw other starts and so other lengths. The policy is the committed one of depth 6 where there is one, else
`STANDING`. The peer plays as its documentation shows, one environment in a Monitor.

Targets: at least 2 times the peer on one core (CPU time), at least 3.5 times on two (wall clock, which includes the start of
the second process and suffers from whatever else runs on the machine; the peer uses one).
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import otr
from benchmarks.measure import Entry
from benchmarks.peers import HOPPER, sac_with_actor
from pipelines.envs import make_env
from pipelines.rollout import rollout
from pipelines.store import load_actor

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
        return int(rollout(tree.predict, HOPPER, seeds, n_workers=n_workers).lengths.sum())

    def theirs() -> int:
        _, lengths = evaluate_policy(model, env, n_eval_episodes=n_episodes, return_episode_rewards=True)
        return int(np.sum(lengths))

    one_core, two_cores = [], []
    for i in range(rounds):
        on_one, theirs_process, theirs_wall = speed(lambda: ours(1))[0], *speed(theirs)
        one_core.append((on_one, theirs_process))
        two_cores.append((speed(lambda: ours(2))[1], theirs_wall))
        print(f"evaluation: round {i + 1} of {rounds} done, {on_one:,.0f} steps/s against {theirs_process:,.0f}", flush=True)
    name, peer = f"{n_episodes} episodes of Hopper, {policy}", "evaluate_policy"
    (on_one, theirs_process), (on_two, theirs_wall) = np.max(one_core, axis=0), np.max(two_cores, axis=0)
    return [
        Entry(f"{name}: one core", float(on_one), "steps/s", peer, float(theirs_process), "ratio >= 2"),
        Entry(
            f"{name}: two cores", float(on_two), "steps/s", peer, float(theirs_wall), "ratio >= 3.5", clock="wall"
        ),
    ]


def hopper_policy() -> tuple[otr.ReluNetwork, str]:
    """Return an actor of six neurons whose episodes are long, and what to call it."""
    if (COMMITTED / "actor.json").exists():
        return load_actor(COMMITTED), "trained policy"
    return standing_policy(), "standing policy"


def standing_policy() -> otr.ReluNetwork:
    """Return K x + k as a network: relu(K x + k) - relu(-K x - k)."""
    K, k = np.array(STANDING_GAINS), np.array(STANDING_OFFSETS)
    plus_minus = np.hstack((np.eye(3), -np.eye(3)))
    weights, biases = [np.vstack((K, -K)), plus_minus], [np.concatenate((k, -k)), np.zeros(3)]
    return otr.ReluNetwork(weights, biases, head=otr.TanhBox(-np.ones(3), np.ones(3)))


def speed(play: Callable[[], int]) -> tuple[float, float]:
    """Return the environment steps that `play` does per second of this process's CPU time, and of wall clock."""
    process, wall = time.process_time(), time.perf_counter()
    n_steps = play()
    return n_steps / (time.process_time() - process), n_steps / (time.perf_counter() - wall)
