"""Episodes: the same episodes however they are run, and the same as one environment stepped by hand."""

import gymnasium as gym
import numpy as np
import pytest

import otr
from pipelines.play.environments import make_env
from pipelines.play.episodes import play_seeds
from tests.core.strategies import make_network
from tests.pipelines.conftest import HOPPER, LANDER, PENDULUM

FIELDS = ("seeds", "returns", "lengths", "terminated", "truncated", "states", "actions")


def random_network(env, seed=0, width=5):
    single = make_env(env)
    d, space = single.observation_space.shape[0], single.action_space
    is_discrete = isinstance(space, gym.spaces.Discrete)
    o, head = (int(space.n), otr.Argmax()) if is_discrete else (len(space.low), otr.TanhBox(space.low, space.high))
    return make_network(np.random.default_rng(seed), (width,), n_inputs=d, n_outputs=o).replace(head=head)


def by_hand(network, env_config, seed):
    env = make_env(env_config)
    state, _ = env.reset(seed=seed)
    total, length, states = 0.0, 0, []
    while True:
        states.append(np.asarray(state, dtype=np.float64))
        action = network.predict(states[-1])
        action = int(action) if np.ndim(action) == 0 else np.asarray(action, dtype=env.action_space.dtype)
        state, reward, terminated, truncated, _ = env.step(action)
        total, length = total + float(reward), length + 1
        if terminated or truncated:
            return total, length, terminated, truncated, states


@pytest.mark.parametrize("env", [PENDULUM, LANDER, HOPPER], ids=lambda env: env.name)
def test_equals_one_environment_stepped_by_hand(env):
    network, seeds = random_network(env), [3, 11, 1000]
    played = play_seeds(network.predict, env, seeds, keep_states=True, n_workers=1)
    expected = [by_hand(network, env, seed) for seed in seeds]
    *parts, states = zip(*expected, strict=True)
    assert [getattr(played, name).tolist() for name in FIELDS[1:5]] == [list(part) for part in parts]
    np.testing.assert_array_equal(played.states, np.concatenate(states))
    if env is not LANDER:  # whose actions are labels
        again = play_seeds(otr.map_network(network).predict, env, seeds, n_workers=1)
        assert again.states.size == 0 and again.returns.tolist() == played.returns.tolist()


@pytest.mark.parametrize("env", [LANDER, HOPPER], ids=lambda env: env.name)
def test_number_of_processes_and_order_change_nothing(env):
    network, seeds = random_network(env), list(range(40))
    one = play_seeds(network.predict, env, seeds, keep_states=True, n_workers=1)
    two = play_seeds(network.predict, env, seeds, keep_states=True, n_workers=2)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
    backwards = play_seeds(network.predict, env, seeds[::-1], n_workers=1)
    np.testing.assert_array_equal(backwards.returns[::-1], one.returns)
