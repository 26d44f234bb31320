"""The plants in numpy against gymnasium's environments: the same seeds and actions give the same episodes."""

import numpy as np
import pytest

from otr.control.environments import Stepped, VectorEnv
from pipelines.config.env import EnvConfig
from pipelines.play.classic_control import EQUAL_IDS
from pipelines.play.vector_envs import make_vector_env

N_ENVS = 20
SEEDS = [2**32 - 1, *range(N_ENVS - 1)]
REWARD_DIFFERENCE = {"Pendulum-v1": 5e-10, "MountainCarContinuous-v0": 0.0}
LIMIT = {"Pendulum-v1": 2.0, "MountainCarContinuous-v0": 1.0}


def config(env_id: str, **kwargs: object) -> EnvConfig:
    return EnvConfig(env_id, env_id, env_id, kwargs)


def both(env_id: str) -> list[VectorEnv]:
    """Return the environments of gymnasium and those in numpy."""
    return [make_vector_env(config(env_id), environments) for environments in ("gymnasium", "numpy")]


def assert_same(ours: Stepped, theirs: Stepped, reward_difference: float) -> None:
    for part, expected in zip(ours, theirs, strict=True):
        assert part.dtype == expected.dtype and part.shape == expected.shape
    np.testing.assert_array_equal(ours.states, theirs.states)
    np.testing.assert_array_equal(ours.terminated, theirs.terminated)
    np.testing.assert_array_equal(ours.truncated, theirs.truncated)
    assert np.abs(ours.rewards - theirs.rewards).max() <= reward_difference


@pytest.mark.parametrize("env_id", EQUAL_IDS)
def test_episodes_are_gymnasiums(env_id):
    """Actions are random, beyond their limits and at them; half of the cars push along to reach the goal."""
    theirs, ours = both(env_id)
    states = theirs.reset(SEEDS)
    first = ours.reset(SEEDS)
    assert np.array_equal(first, first.astype(np.float32))  # which the environments give
    np.testing.assert_array_equal(first, states)
    generator, limit = np.random.default_rng(0), LIMIT[env_id]
    n_terminated = n_truncated = 0
    for t in range(1500):
        actions = generator.uniform(-1.5 * limit, 1.5 * limit, (N_ENVS, 1)).astype(np.float32)
        actions[::2] = np.sign(states[::2, -1:]) * np.abs(actions[::2])
        actions[t % N_ENVS] = limit
        expected = theirs.step(actions)
        assert_same(ours.step(actions), expected, REWARD_DIFFERENCE[env_id])
        states = expected.states
        ended = np.flatnonzero(expected.terminated | expected.truncated)
        n_terminated += expected.terminated.sum()
        n_truncated += expected.truncated.sum()
        if len(ended):
            np.testing.assert_array_equal(ours.reset(None, ended), theirs.reset(None, ended))
    if env_id == "Pendulum-v1":
        assert (n_terminated, n_truncated) == (0, 7 * N_ENVS)
    else:
        assert n_terminated >= 50 and n_truncated >= 5


def test_the_cars_wall_and_its_first_step():
    """At the wall the velocity is zero; a first step is computed in float64, with a force at its limit or within."""
    theirs, ours = both(EQUAL_IDS[0])
    assert EQUAL_IDS[0].startswith("MountainCar")
    np.testing.assert_array_equal(ours.reset(range(400)), theirs.reset(range(400)))
    generator, at_wall = np.random.default_rng(1), 0
    for _ in range(3):
        actions = generator.uniform(-2, 2, (400, 1)).astype(np.float32)
        assert_same(ours.step(actions), theirs.step(actions), 0.0)
    theirs, ours = both(EQUAL_IDS[0])
    states = theirs.reset([1, 2, 3, 4])
    ours.reset([1, 2, 3, 4])
    for _ in range(600):
        push = np.where(states[:, 0] > -0.3, -1, np.sign(states[:, 1]))  # swings, but never up the hill of the goal
        expected = theirs.step(push[:, None].astype(np.float32))
        assert_same(ours.step(push[:, None].astype(np.float32)), expected, 0.0)
        states = expected.states
        at_wall += (states == np.float32([-1.2, 0])).all(axis=1).sum()
    assert at_wall >= 4
