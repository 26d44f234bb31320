"""The evaluation episodes in numpy against those in gymnasium."""

import numpy as np

import otr
from pipelines.play.episodes import play_each, play_evaluation
from tests.pipelines.play.test_episodes import PENDULUM, random_network


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
