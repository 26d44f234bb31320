"""Environments side by side: what a step returns where an episode ends; neighbours change nothing."""

import numpy as np
import pytest

from otr.control.sac.autoreset import Autoreset, Step
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import make_env
from pipelines.play.vector_envs import make_vector_env

HOPPER = EnvConfig("hopper", "hopper", "Hopper-v4")
PENDULUM = EnvConfig("pendulum", "pendulum", "Pendulum-v1", {"max_episode_steps": 5})
LIMITED = EnvConfig("hopper", "hopper", "Hopper-v4", {"max_episode_steps": 20})
CAR = EnvConfig("mountaincar", "mountaincar", "MountainCarContinuous-v0", {"max_episode_steps": 30})
N_STEPS = 90  # a hopper with random actions falls after about 20


def actions_of(n_envs: int, n_components: int, first: int = 0) -> np.ndarray:
    """Return (N_STEPS, n, a) actions; those of environment i are environment first + i's, whatever n is."""
    generators = [np.random.default_rng(100 + first + i) for i in range(n_envs)]
    return np.stack([g.uniform(-1, 1, (N_STEPS, n_components)) for g in generators], axis=1).astype(np.float32)


def autoreset(config: EnvConfig, *, rescale_inputs: bool = False) -> Autoreset:
    return Autoreset(make_vector_env(config, "gymnasium", rescale_inputs=rescale_inputs))


def play(envs: Autoreset, seeds: list[int], actions: np.ndarray) -> tuple[np.ndarray, Step]:
    """Return the first states, and the steps stacked along a new first axis when all of them are done."""
    first = envs.reset(seeds)
    steps = [envs.step(row) for row in actions]
    return first, Step(*(np.stack(parts) for parts in zip(*steps, strict=True)))


def assert_same(one: tuple[np.ndarray, Step], other: tuple[np.ndarray, Step]) -> None:
    np.testing.assert_array_equal(one[0], other[0])
    for name, mine, theirs in zip(Step._fields, one[1], other[1], strict=True):
        np.testing.assert_array_equal(mine, theirs, err_msg=name)


def loop(config: EnvConfig, seed: int, actions: np.ndarray) -> tuple[np.ndarray, Step]:
    """Play one environment by gymnasium's own interface, what `play` returns without the axis of environments."""
    env = make_env(config)
    first, _ = env.reset(seed=seed)
    steps = []
    for action in actions:
        successor, reward, terminated, truncated, _ = env.step(action)
        state = env.reset()[0] if terminated or truncated else successor
        steps.append((np.float32(successor), np.float32(reward), terminated, truncated, np.float32(state)))
    return np.float32(first), Step(*(np.stack(parts) for parts in zip(*steps, strict=True)))


@pytest.mark.parametrize(("config", "n_components"), [(HOPPER, 3), (LIMITED, 3), (PENDULUM, 1)])
def test_every_environment_is_gymnasiums_own_whatever_was_played_before(config, n_components):
    """Also where an episode ends: the last state and the first one of the next; steps are the caller's to keep."""
    seeds, actions = [7, 3, 3, 2**32 - 1, 8], actions_of(5, n_components)
    envs = autoreset(config)
    play(envs, [9] * 5, actions[:7])
    first, steps = play(envs, seeds, actions)
    envs.close()
    assert [part.dtype for part in steps] == [np.float32, np.float32, bool, bool, np.float32]
    assert first.dtype == np.float32 and len(first) == 5
    for i, seed in enumerate(seeds):
        assert_same((first[i], Step(*(part[:, i] for part in steps))), loop(config, seed, actions[:, i]))
    assert steps.terminated.any() == (n_components == 3) and steps.truncated.any() == (config is not HOPPER)


def test_rescaled_states():
    actions = actions_of(2, 1)
    plain, steps = play(autoreset(CAR), [1, 2], actions)
    _, scaled = play(autoreset(CAR, rescale_inputs=True), [1, 2], actions)
    low, high = np.array([-1.2, -0.07]), np.array([0.6, 0.07])
    for name in ("next_states", "states"):
        expected = 2 * (getattr(steps, name) - low) / (high - low) - 1
        np.testing.assert_allclose(getattr(scaled, name), expected, atol=1e-6)
    assert steps.truncated.sum() == 6 and plain.dtype == np.float32
    with pytest.raises(ConfigError, match="Hopper-v4 have no bounds"):
        make_vector_env(HOPPER, "gymnasium", rescale_inputs=True)
    with pytest.raises(ConfigError, match="Nothing-v0"):
        make_vector_env(EnvConfig("nothing", "nothing", "Nothing-v0"), "gymnasium")


def test_an_environment_of_ones_own_gets_actions_of_its_space_and_others_as_they_are():
    own = make_vector_env(EnvConfig("own", "continuous", "tests.pipelines.own_envs:Insistent-v0"), "gymnasium")
    own.reset([0, 1])
    own.step(np.array([[0.1], [0.2]]))
    hoppers = make_vector_env(HOPPER, "gymnasium")
    hoppers.reset([0, 1])
    taken = []
    for env in hoppers._envs:
        env.step = lambda action: taken.append(action) or (np.zeros(11), 0.0, False, False, {})
    hoppers.step(np.full((2, 3), 0.1))
    assert [action.dtype for action in taken] == [np.float64, np.float64]
