"""Environments as their files describe them."""

import gymnasium as gym
import numpy as np
import pytest

from otr.control.environments import depends_on_past
from pipelines.cli.runs import run_config
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import is_made_anew, make_env
from pipelines.play.episodes import play_seeds
from pipelines.play.own_environment import own_environment
from pipelines.play.spaces import state_box, state_limits


@pytest.mark.parametrize("name", [path.stem for path in (CONF_DIR / "env").glob("*.yaml")])
def test_names_fit_the_environment_and_an_episode_depends_on_its_seed_alone(name, tmp_path, monkeypatch, capfd):
    """Short episodes with random actions, in one environment after others and in a new one, bit for bit."""
    monkeypatch.chdir(tmp_path)
    config = run_config([f"env={name}"]).env
    assert (config.name, config.task) == (name, name.removesuffix("_v5"))
    assert config.own_names() == {}  # conf's names are in no key
    env = make_env(config)
    n_actions = env.action_space.n if isinstance(env.action_space, gym.spaces.Discrete) else env.action_space.shape[0]
    assert len(set(config.feature_names)) == len(config.feature_names) == env.observation_space.shape[0]
    assert len(config.action_names) == n_actions and np.isfinite(env.reset(seed=1)[0]).all()
    assert not depends_on_past(lambda: make_env(config), n_steps=200)
    assert is_made_anew(config) is (config.id == "BipedalWalker-v3")
    assert capfd.readouterr().err == "" and list(tmp_path.iterdir()) == []


def test_a_custom_environment_that_keeps_a_past_is_made_anew_which_is_said_once(capfd):
    worn = own_environment("tests.pipelines.own_envs:Worn-v0", {})
    played = [play_seeds(lambda X: np.ones((len(X), 1)), worn, seeds, n_workers=1) for seeds in ([3], [1, 2, 3])]
    assert played[0].returns[0] == played[1].returns[2]
    assert depends_on_past(lambda: gym.make("BipedalWalker-v3"))  # once this fails, NOT_AFRESH can do without it
    assert capfd.readouterr().err == (
        "tests.pipelines.own_envs:Worn-v0: its episodes depend on those before; it is recreated for each\n"
    )


def test_a_state_that_is_declared_constant_has_a_box_as_it_is_declared():
    config = own_environment("tests.pipelines.own_envs:Fixed-v0", {})
    low, high = state_limits(config)
    assert (low.tolist(), high.tolist()) == ([-5.0, 0.5], [5.0, 0.5])
    middle, half = state_box(config)
    assert (middle.tolist(), half.tolist()) == ([0.0, 0.5], [5.0, 1.0])
    for env_id, message in (("Nothing-v0", "Nothing-v0"), ("Pendulum-v1", "wheels")):
        with pytest.raises(ConfigError, match=message):
            make_env(EnvConfig("some", "some", env_id, {"wheels": 4}))


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
def test_mistakes_of_an_environment_are_reported_before_anything_runs(name, message):
    with pytest.raises(ConfigError, match=message):
        own_environment(f"tests.pipelines.own_envs:{name}-v0", {})
