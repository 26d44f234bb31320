"""How settings differ, and what is refused at the door."""

import dataclasses

import pytest

from pipelines.config.env import EnvConfig
from pipelines.config.stages import EvaluateConfig
from pipelines.engine.digests import setting_differences
from pipelines.errors import ConfigError
from pipelines.play.spaces import feature_names
from tests.pipelines.conftest import PPO, SAC


def test_differences_name_the_leaf_with_both_values(tiny):
    new, old = tiny(evaluate=EvaluateConfig(5, 1000)).settings(), tiny().settings()
    assert setting_differences(new, old) == {"evaluate.n_episodes": [5, 3]}


@pytest.mark.parametrize("depth", [-1, [4, -2], [4, 0], [], "six", 2.5, True, [2, "3"]])
def test_depths_that_are_no_networks_are_refused(tiny, depth):
    with pytest.raises(ConfigError, match="depth="):
        tiny(depth=depth)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"stages": ["mapp"]}, "no stage 'mapp'"),
        ({"results_dir": ""}, "results_dir is empty"),
        ({"algo": dataclasses.replace(SAC, ent_coef="foo")}, "algo.ent_coef=foo"),
        ({"algo": dataclasses.replace(SAC, ent_coef="1.2.3")}, "algo.ent_coef=1.2.3: use auto, or a number"),
        ({"algo": dataclasses.replace(PPO, use_sde=True)}, "algo.use_sde=true: actors of method=otr cannot be read"),
        ({"evaluate": EvaluateConfig(3, 2**20 - 2)}, "the last episode has seed 1048576, and"),
    ],
)
def test_what_no_range_says_is_refused_by_name(tiny, changes, words):
    with pytest.raises(ConfigError, match=words):
        tiny(**changes)


def test_names_of_features_must_fit_the_policy():
    env = EnvConfig("pendulum", "pendulum", "Pendulum-v1", {}, ["a", "b"], [])
    with pytest.raises(ConfigError, match="2 names, the policy has 3"):
        feature_names(env, 3)
    assert feature_names(dataclasses.replace(env, feature_names=[]), 2) == ["x0", "x1"]
