"""The run's folder, its digest, and what is refused at the door."""

import dataclasses
from pathlib import Path

import pytest

from pipelines.cli.runs import load_config
from pipelines.config.env import EnvConfig
from pipelines.config.run import run_folder
from pipelines.config.stages import EvaluateConfig
from pipelines.engine.digests import setting_differences
from pipelines.errors import ConfigError
from tests.pipelines.conftest import PPO, SAC

RESULTS = Path(__file__).parents[3] / "results"


def test_folder_names_env_method_depth_budget_and_seed(tiny):
    assert run_folder(tiny(), {}) == "runs/pendulum/otr/depth-4/smoke/seed-0"
    several = tiny(depth=[8, 3], seed=12)
    assert run_folder(several, {}) == "runs/pendulum/otr/depth-8-3/smoke/seed-12"


def test_other_overrides_get_a_folder_of_their_own(tiny):
    plain = tiny()
    changed = tiny(algo=dataclasses.replace(plain.algo, gamma=0.9))
    again = tiny(algo=dataclasses.replace(plain.algo, gamma=0.9))
    other = tiny(algo=dataclasses.replace(plain.algo, gamma=0.8))
    differences = [
        setting_differences(config.settings(), plain.settings()) for config in (plain, changed, again, other)
    ]
    folders = [run_folder(plain, each) for each in differences]
    assert folders[1].startswith("runs/pendulum/otr/depth-4/smoke/seed-0~")
    assert folders[1] == folders[2]
    assert len(set(folders)) == 3


def test_execution_settings_do_not_change_the_folder(tiny):
    moved = tiny(results_dir="elsewhere", n_workers=2, debug=True, stages=["map"])
    assert run_folder(moved, {}) == run_folder(tiny(), {})
    assert moved.settings() == tiny().settings()


def test_differences_name_the_leaf_with_both_values(tiny):
    new, old = tiny(evaluate=EvaluateConfig(5, 1000)).settings(), tiny().settings()
    assert setting_differences(new, old) == {"evaluate.n_episodes": [5, 3]}


@pytest.mark.parametrize("depth", [-1, [4, -2], [4, 0], [], "six", 2.5, True, [2, "3"]])
def test_depths_that_are_no_networks_are_refused(tiny, depth):
    with pytest.raises(ConfigError, match="depth="):
        tiny(depth=depth)


def test_depth_zero_is_the_linear_policy(tiny):
    assert tiny(depth=0).hidden_widths == ()
    assert run_folder(tiny(depth=0), {}).endswith("depth-0/smoke/seed-0")


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


def test_names_of_features_must_fit_the_policy(tiny):
    from pipelines.play.spaces import feature_names

    env = EnvConfig("pendulum", "pendulum", "Pendulum-v1", {}, ["a", "b"], [])
    with pytest.raises(ConfigError, match="2 names, the policy has 3"):
        feature_names(env, 3)
    assert feature_names(dataclasses.replace(env, feature_names=[]), 2) == ["x0", "x1"]


def test_the_committed_runs_of_a_fleet_can_be_loaded():
    config = load_config(RESULTS / "runs/pendulum/otr/depth-6/quick-fleet/seed-0", None)
    assert config.fleet is not None and config.fleet.n_envs == 1
