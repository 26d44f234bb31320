"""Environments side by side: what a step returns where an episode ends; neighbours change nothing."""

import numpy as np
import pytest

from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import make_env
from pipelines.play.vector_envs import Autoreset, Step, make_vector_env

HOPPER = EnvConfig("hopper", "hopper", "Hopper-v4")
PENDULUM = EnvConfig("pendulum", "pendulum", "Pendulum-v1", {"max_episode_steps": 5})
CAR = EnvConfig("mountaincar", "mountaincar", "MountainCarContinuous-v0", {"max_episode_steps": 30})
N_STEPS = 90  # a hopper with random actions falls after about 20


def actions_of(n_envs: int, n_components: int, first: int = 0) -> np.ndarray:
    """Return (N_STEPS, n, a) actions; those of environment i are environment first + i's, whatever n is."""
    generators = [np.random.default_rng(100 + first + i) for i in range(n_envs)]
    return np.stack([g.uniform(-1, 1, (N_STEPS, n_components)) for g in generators], axis=1).astype(np.float32)


def autoreset(config: EnvConfig, *, rescale_inputs: bool = False) -> Autoreset:
    return Autoreset(make_vector_env(config, "gymnasium", rescale_inputs=rescale_inputs))


def play(envs: Autoreset, seeds: list[int], actions: np.ndarray) -> tuple[np.ndarray, Step]:
    """Return the first states, and the steps stacked along a new first axis."""
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


def test_every_environment_is_gymnasiums_own():
    seeds, actions = [7, 3, 3, 2**32 - 1, 8], actions_of(5, 3)
    envs = autoreset(HOPPER)
    first, steps = play(envs, seeds, actions)
    envs.close()
    assert [part.dtype for part in steps] == [np.float32, np.float32, bool, bool, np.float32]
    assert first.dtype == np.float32 and first.shape == (5, 11)
    for i, seed in enumerate(seeds):
        assert_same((first[i], Step(*(part[:, i] for part in steps))), loop(HOPPER, seed, actions[:, i]))
    assert steps.terminated.sum() >= 10 and not steps.truncated.any()


def test_terminal_state_and_first_state_of_the_next_episode():
    envs = autoreset(HOPPER)
    _, steps = play(envs, [1, 2, 3], actions_of(3, 3))
    ended = steps.terminated
    # A hopper has fallen below 0.7 or tilted by more than 0.2; it starts within 0.005 of 1.25 and 0.
    height, tilt = steps.next_states[ended][:, 0], steps.next_states[ended][:, 1]
    assert ((height < 0.7) | (np.abs(tilt) > 0.2)).all()
    assert np.abs(steps.states[ended] - np.eye(11)[0] * 1.25).max() < 0.0051
    np.testing.assert_array_equal(steps.states[~ended], steps.next_states[~ended])
    # What the next step starts from is the reset state, not the terminal one.
    after = np.roll(ended, 1, axis=0)
    after[0] = False
    assert np.abs(steps.next_states[after][:, 0] - 1.25).max() < 0.05


def test_time_limit_truncates_and_does_not_terminate():
    envs = autoreset(PENDULUM)
    _, steps = play(envs, [1, 2, 3], actions_of(3, 1)[:12])
    envs.close()
    assert np.flatnonzero(steps.truncated.all(axis=1)).tolist() == [4, 9]
    assert steps.truncated.sum() == 6 and not steps.terminated.any()
    assert (steps.next_states[4] != steps.states[4]).all()


def test_terminal_state_at_the_time_limit_is_both():
    actions = actions_of(1, 3)
    _, steps = play(autoreset(HOPPER), [1], actions)
    last = int(np.argmax(steps.terminated[:, 0]))
    limited = EnvConfig("hopper", "hopper", "Hopper-v4", {"max_episode_steps": last + 1})
    _, steps = play(autoreset(limited), [1], actions[: last + 1])
    assert steps.terminated[last, 0] and steps.truncated[last, 0]
    assert steps.terminated.sum() == steps.truncated.sum() == 1


def test_same_seeds_same_trajectory_whatever_was_played_before():
    actions = actions_of(3, 3)
    envs = autoreset(HOPPER)
    first = play(envs, [4, 5, 6], actions)
    play(envs, [9, 9, 9], actions[:7])
    assert_same(play(envs, [4, 5, 6], actions), first)
    envs.close()
    assert not np.array_equal(first[1].states[:, 0], first[1].states[:, 1])


@pytest.mark.parametrize(("config", "n_components"), [(HOPPER, 3), (PENDULUM, 1)], ids=["float64", "float32"])
def test_steps_are_the_callers_to_keep(config, n_components):
    envs = autoreset(config)
    first = envs.reset([1, 2])
    step = envs.step(np.zeros((2, n_components), np.float32))
    kept = [part.copy() for part in (first, *step)]
    envs.step(np.ones((2, n_components), np.float32))
    envs.close()
    for part, copy in zip((first, *step), kept, strict=True):
        np.testing.assert_array_equal(part, copy)


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
