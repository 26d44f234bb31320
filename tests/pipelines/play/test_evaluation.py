"""The evaluation episodes in numpy against those in gymnasium."""

import dataclasses

import numpy as np
import pytest

import otr
from pipelines.config.env import EnvConfig
from pipelines.play.episodes import play_each, play_evaluation, play_seeds
from pipelines.play.vector_envs import fastest_environments
from tests.pipelines.play.test_episodes import PENDULUM, random_network

ENVS = {  # and an action for each: c + M . x, clipped
    "pendulum": (EnvConfig("pendulum", "pendulum", "Pendulum-v1"), [1.0, -3.0, -0.7], 2.0),
    "mountaincar": (EnvConfig("mountaincar", "mountaincar", "MountainCarContinuous-v0"), [0.0, 100.0], 1.0),
}


@pytest.mark.parametrize("name", ENVS)
def test_the_episodes_in_numpy_are_gymnasiums(name):
    env, M, limit = ENVS[name]
    no_tests = [], [], np.zeros((0, len(M))), []
    tree = otr.ObliqueTree(*no_tests, [[M]], [[0.1]], head=otr.ClipBox([-limit], [limit]))
    seeds = list(range(1000, 1012))
    ours = play_seeds(tree.predict, env, seeds, keep_states=True, environments="numpy")
    theirs = play_seeds(tree.predict, env, seeds, keep_states=True, n_workers=1)
    np.testing.assert_allclose(ours.returns, theirs.returns, atol=1e-6)
    for field in ("seeds", "lengths", "terminated", "truncated", "states", "actions"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
    assert ours.terminated.all() == (name == "mountaincar") and len(set(ours.returns)) == len(seeds)
    assert ours.actions.dtype == theirs.actions.dtype
    assert not len(play_seeds(tree.predict, env, seeds, environments="numpy").states)
    assert fastest_environments(env) == "numpy"
    assert fastest_environments(dataclasses.replace(env, kwargs={"g": 9.0})) == "gymnasium"


def test_policies_that_act_alike_are_played_once(tiny, monkeypatch):
    """The same to the last bit that an environment is given; one that differs in a single leaf is played itself."""
    config = tiny()
    network = random_network(PENDULUM, seed=1, width=3)
    tree = otr.map_network(network)
    states = play_evaluation(network.predict, config, keep_states=True).states
    leaf = int(np.bincount(tree.apply(states)).argmax())
    other = tree.replace(c=tree.c + 1e-3 * (np.arange(tree.n_leaves) == leaf)[:, None])
    policies = {"network": network, "tree": tree, "other": other, "again": other}
    alone = {name: play_evaluation(policy.predict, config).returns for name, policy in policies.items()}
    times = []
    monkeypatch.setattr(
        "pipelines.play.episodes.play_evaluation",
        lambda *args, **kwargs: (times.append(1), play_evaluation(*args, **kwargs))[1],
    )
    played = play_each(policies, config)
    assert len(times) == 2
    for name, returns in alone.items():
        np.testing.assert_array_equal(played[name].returns, returns, err_msg=name)
    assert played["other"] is played["again"] and not np.array_equal(alone["tree"], alone["other"])
