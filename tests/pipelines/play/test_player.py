"""Episodes of many policies at a time are the episodes that each plays alone."""

import numpy as np
import pytest

import otr
from pipelines.config.env import EnvConfig
from pipelines.play.episodes import MOST_AT_ONCE, Player, play_seeds
from tests.pipelines.conftest import HOPPER, PENDULUM

CARTPOLE = EnvConfig("cartpole", "cartpole", "CartPole-v1")


def networks(d: int, o: int, head: otr.Head, k: int = 3) -> list[otr.ReluNetwork]:
    draw = np.random.default_rng(0).normal
    arrays = [([draw(size=(2, d)), draw(size=(o, 2 + d))], [draw(size=2), draw(size=o)]) for _ in range(k)]
    return [otr.ReluNetwork(*each, dense="input", head=head) for each in arrays]


@pytest.mark.parametrize(
    ("env", "environments", "policies"),
    [
        (CARTPOLE, "gymnasium", networks(4, 2, otr.Argmax())),
        (PENDULUM, "numpy", networks(3, 1, otr.ClipBox(-2.0, 2.0))),
        (HOPPER, "gymnasium", networks(11, 3, otr.ClipBox(-1.0, 1.0), 2)),
    ],
)
@pytest.mark.parametrize("at_once", [4, 256])
def test_as_each_alone(monkeypatch, env, environments, policies, at_once):
    monkeypatch.setitem(MOST_AT_ONCE, environments, at_once)
    k = len(policies)
    seeds = np.arange(5 * k).reshape(k, 5)
    pairs = zip(policies, seeds.tolist(), strict=True)
    alone = [play_seeds(policy.predict, env, row, keep_states=True) for policy, row in pairs]
    for kind in (policies, [otr.map_network(policy) for policy in policies]):
        played = Player(env, environments).play(kind, seeds, keep_states=True)
        returns = [each.returns for each in alone]
        np.testing.assert_allclose(played.returns, returns, rtol=1e-4)  # contacts multiply rounding
        np.testing.assert_array_equal(played.lengths, [each.lengths for each in alone])
        assert len(np.unique(played.lengths)) > 1 or env is PENDULUM
        states = np.concatenate([each.states for each in alone])
        np.testing.assert_allclose(played.states.mean(axis=0), states.mean(axis=0), atol=1e-3)
        assert played.states.shape == states.shape


def test_without_the_alive_bonus_and_no_longer_than_the_horizon():
    seeds = np.arange(6).reshape(3, 2)
    played = Player(CARTPOLE, "gymnasium").play(networks(4, 2, otr.Argmax()), seeds, alive_bonus=1.0)
    assert np.array_equal(played.returns, np.zeros((3, 2))) and played.lengths.min() > 1
    policies, episodes = networks(3, 1, otr.ClipBox(-2.0, 2.0)), Player(PENDULUM, "numpy")
    short, long = episodes.play(policies, seeds, horizon=50), episodes.play(policies, seeds)
    assert (short.lengths == 50).all() and (long.lengths == 200).all()
    assert (short.returns > long.returns).all()  # every step costs
