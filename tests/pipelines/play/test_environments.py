"""Environments as their files describe them."""

import gymnasium as gym
import numpy as np
import pytest
import yaml

from otr.control.environments import depends_on_past
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import is_made_anew, make_env
from pipelines.play.episodes import play_seeds
from pipelines.play.own_environment import own_environment
from pipelines.play.spaces import state_box, state_limits

FILES = sorted((CONF_DIR / "env").glob("*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_names_fit_the_environment(path, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    config = EnvConfig(**yaml.safe_load(path.read_text())["env"])
    assert config.name == path.stem
    assert config.task == path.stem.removesuffix("_v5")
    env = make_env(config)
    assert len(config.feature_names) == env.observation_space.shape[0]
    assert len(set(config.feature_names)) == len(config.feature_names)
    actions = env.action_space
    assert len(config.action_names) == (actions.n if isinstance(actions, gym.spaces.Discrete) else actions.shape[0])
    state, _ = env.reset(seed=1)
    assert np.isfinite(state).all()
    printed = capfd.readouterr()
    assert printed.err == "" and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_episode_depends_on_its_seed_alone(path):
    """Short episodes with random actions, in one environment after others and in a new one, bit for bit."""
    config = EnvConfig(**yaml.safe_load(path.read_text())["env"])
    assert not depends_on_past(lambda: make_env(config), n_steps=200)
    assert is_made_anew(config) is (config.id == "BipedalWalker-v3")


def test_the_biped_is_made_anew_as_gymnasium_keeps_its_world():
    assert depends_on_past(lambda: gym.make("BipedalWalker-v3"))  # once this fails, NOT_AFRESH can do without it


def test_a_custom_environment_that_keeps_a_past_is_made_anew_which_is_said_once(capfd):
    worn = own_environment("tests.pipelines.own_envs:Worn-v0", {})
    played = [play_seeds(lambda X: np.ones((len(X), 1)), worn, seeds, n_workers=1) for seeds in ([3], [1, 2, 3])]
    assert played[0].returns[0] == played[1].returns[2]
    assert capfd.readouterr().err == (
        "tests.pipelines.own_envs:Worn-v0: its episodes depend on those before; it is made anew for each\n"
    )


def test_a_state_that_is_declared_constant_has_a_box_as_it_is_declared():
    config = own_environment("tests.pipelines.own_envs:Fixed-v0", {})
    low, high = state_limits(config)
    assert (low.tolist(), high.tolist()) == ([-5.0, 0.5], [5.0, 0.5])
    middle, half = state_box(config)
    assert (middle.tolist(), half.tolist()) == ([0.0, 0.5], [5.0, 1.0])


def test_unknown_environment_is_named():
    with pytest.raises(ConfigError, match="Nothing-v0"):
        make_env(EnvConfig("nothing", "nothing", "Nothing-v0"))


def test_argument_the_environment_does_not_take():
    with pytest.raises(ConfigError, match="wheels"):
        make_env(EnvConfig("pendulum", "pendulum", "Pendulum-v1", {"wheels": 4}))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("OfOldGym", r"reset\(seed=0\) fails: TypeError: .*'(seed|options)'.* returns \(observation, info\)"),
        ("ReturnsFour", r"step\(action\) fails: ValueError: .*expected 5, got 4.* truncated, info\)"),
        ("LongerThanItsSpace", r"reset\(seed=0\) fails: .*shape \(3,\), the observation space \(2,\)"),
        ("NotFinite", r"step\(action\) fails: .*not finite: \[nan"),
        ("NeedsAFile", r"cannot be made: FileNotFoundError: track.csv"),
    ],
)
def test_mistakes_of_an_own_environment_are_told_before_anything_runs(name, message):
    with pytest.raises(ConfigError, match=message):
        own_environment(f"tests.pipelines.own_envs:{name}-v0", {})
