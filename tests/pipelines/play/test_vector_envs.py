"""What every implementation of `VectorEnv` promises: common random numbers, and steps of some environments."""

import dataclasses

import numpy as np
import pytest

from otr.control.environments import VectorEnv
from pipelines.config.env import EnvConfig, PidTerms
from pipelines.errors import ConfigError
from pipelines.play.environments import make_env
from pipelines.play.spaces import spaces
from pipelines.play.vector_envs import make_vector_env


def config(env_id: str, **kwargs: object) -> EnvConfig:
    return EnvConfig(env_id, env_id, env_id, kwargs)


CASES = [
    ("gymnasium", "Hopper-v4"),
    ("gymnasium", "LunarLander-v3"),
    ("numpy", "MountainCarContinuous-v0"),
    ("numpy", "Pendulum-v1"),
]


@pytest.fixture(params=CASES, ids="-".join)
def case(request) -> tuple[str, str]:
    return request.param


def actions_for(env_id: str, n: int, generator: np.random.Generator) -> np.ndarray:
    env = spaces(config(env_id))
    if env.box is None:
        return generator.integers(env.n_actions, size=n)
    return generator.uniform(*env.box, size=(n, env.n_actions)).astype(np.float32)


def play(envs: VectorEnv, env_id: str, n_steps: int, seed: int) -> None:
    """Do up to `n_steps` random steps in four environments, which rest when their episode has ended."""
    active, generator = np.arange(4), np.random.default_rng(seed)
    for _ in range(n_steps):
        outcome = envs.step(actions_for(env_id, len(active), generator), active)
        active = active[~(outcome.terminated | outcome.truncated)]
        if not len(active):
            return


def test_equal_seeds_start_alike_whatever_was_done_before(case):
    """And go on alike: nothing of the episode before is left over. Common random numbers for the policies there."""
    environments, env_id = case
    envs = make_vector_env(config(env_id), environments)
    first = envs.reset([7, 8, 7, 8])
    assert len(np.unique(first, axis=0)) == 2
    for k in range(3):
        play(envs, env_id, 40, seed=k)
        np.testing.assert_array_equal(envs.reset([7, 8, 7, 8]), np.concatenate((first[:2], first[:2])))
        actions = actions_for(env_id, 2, np.random.default_rng(k))
        for _ in range(5):
            outcome = envs.step(np.concatenate((actions, actions)))
            for part in outcome:
                np.testing.assert_array_equal(part[:2], part[2:])
    np.testing.assert_array_equal(envs.reset([8, 7, 8, 7]), first[::-1])
    envs.close()


def test_steps_of_some_are_steps_of_all(case):
    """Stepped one by one, in any order and company, every environment plays what it plays among all."""
    environments, env_id = case
    n, n_steps = 3, 12
    actions = [actions_for(env_id, n, np.random.default_rng(t)) for t in range(n_steps)]
    envs = make_vector_env(config(env_id, max_episode_steps=5), environments)
    envs.reset([1, 2, 3])
    together = []
    for t in range(n_steps):
        together.append(envs.step(actions[t]))
        if together[-1].truncated.any():
            assert together[-1].truncated.all() and t in (4, 9)
            envs.reset(None, np.arange(n))
    envs.reset([1, 2, 3])
    for order in ([1], [2, 0]):
        for t in range(n_steps):
            outcome = envs.step(actions[t][order], np.array(order))
            for name, part, expected in zip(outcome._fields, outcome, together[t], strict=True):
                assert part.dtype == expected.dtype and len(part) == len(order)
                np.testing.assert_array_equal(part, expected[order], err_msg=f"{name} {order} {t}")
            if outcome.truncated.any():
                envs.reset(None, np.array(order))
    envs.close()


def test_restart_goes_on_in_the_own_stream(case):
    """The other environments' episodes go on, and the k-th start does not depend on when it comes."""
    environments, env_id = case
    envs = make_vector_env(config(env_id), environments)
    envs.reset([5, 6, 7])
    starts = [envs.reset(None, np.arange(3)) for _ in range(10)]
    envs.reset([5, 6, 7])
    for k in range(10):
        np.testing.assert_array_equal(envs.reset(None, np.array([2, 0])), starts[k][[2, 0]])
    np.testing.assert_array_equal(envs.reset(None, np.array([1])), starts[0][[1]])
    if environments == "gymnasium":
        env = make_env(config(env_id))
        env.reset(seed=5)
        np.testing.assert_array_equal(env.reset()[0], starts[0][0])
    envs.close()
    envs.close()


def test_first_states_and_outcomes_are_the_callers_to_keep(case):
    environments, env_id = case
    envs = make_vector_env(config(env_id), environments)
    generator = np.random.default_rng(0)
    arrays = [envs.reset([1, 2]), *envs.step(actions_for(env_id, 2, generator)), envs.reset(None, np.array([1]))]
    kept = [array.copy() for array in arrays]
    for _ in range(5):
        envs.step(actions_for(env_id, 2, generator))
    envs.reset([3, 4])
    for array, copy in zip(arrays, kept, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_what_was_not_compared_is_refused():
    with pytest.raises(ConfigError, match=r"Hopper-v4 is not .* \(MountainCarContinuous-v0, Pendulum-v1\); use env"):
        make_vector_env(config("Hopper-v4"), "numpy")
    with pytest.raises(ConfigError, match=r"environments=numpy: Pendulum-v1 .* has g; use environments=gymnasium"):
        make_vector_env(config("Pendulum-v1", g=9.81, max_episode_steps=5), "numpy")
    with pytest.raises(ConfigError, match="states of PID policies"):
        pid = dataclasses.replace(config("Pendulum-v1"), pid=PidTerms((1.0, 0.0, 0.0), 2))
        make_vector_env(pid, "numpy")
