"""Environments that conf/env has no file for: any registered id, and `module:Id`."""

import dataclasses
import importlib
import re
import sys
from pathlib import Path

import pytest
import yaml

import otr
from pipelines.cli.runs import RUN
from pipelines.config.env import EnvConfig, _code_sha256
from pipelines.errors import ConfigError
from pipelines.play.spaces import feature_names, spaces
from pipelines.stages.certify import CERTIFY
from pipelines.stages.imitate import IMITATE
from pipelines.stages.parse import PARSE
from pipelines.stages.polish import POLISH
from pipelines.stages.prune import PRUNE
from pipelines.stages.simplify import SIMPLIFY
from pipelines.stages.train import TRAIN
from tests.pipelines.conftest import otr_command

MODULE = "tests.pipelines.own_envs"
CART = f"env={MODULE}:Cart-v0"


def job(*words):
    (made,) = RUN.jobs(RUN.expand(list(words), multirun=False))
    return made


@pytest.mark.parametrize(
    ("word", "name", "algorithm", "features"),
    [
        ("env=CartPole-v1", "CartPole-v1", "ppo", ["position", "velocity", "angle", "angle_rate"]),
        ("env=MountainCarContinuous-v0", "mountaincar", "ddpg", ["position", "velocity"]),  # has a file
        (CART, "tests.pipelines.own_envs_Cart-v0", "sac", ["position", "velocity"]),
        (f"env={MODULE}:PushOrPull-v0", "tests.pipelines.own_envs_PushOrPull-v0", "ppo", []),
    ],
)
def test_an_id_is_an_environment(word, name, algorithm, features):
    made = job(word, "budget=quick", "depth=2")
    assert made.folder == f"runs/{name}/otr/depth-2/quick/seed-0"
    assert made.config.algo.name == algorithm
    assert made.config.env.feature_names == features
    assert made.command == f"otr-run {'env=mountaincar' if name == 'mountaincar' else word} budget=quick depth=2"


@pytest.mark.parametrize("env_id", ["Acrobot-v1", "CartPole-v0", "CartPole-v1", "MountainCar-v0"])
def test_gymnasiums_classic_environments_have_names(env_id):
    env = job(f"env={env_id}", "budget=smoke", "depth=2").config.env
    sizes = spaces(env)
    assert (len(env.feature_names), len(env.action_names)) == (sizes.n_inputs, sizes.n_actions)
    assert env.own_names() and "x0" not in feature_names(env, sizes.n_inputs)
    given = job(f"env={env_id}", "budget=smoke", f"env.action_names=[{','.join('abc'[: sizes.n_actions])}]").config.env
    assert given.action_names[0] == "a" and given.feature_names == env.feature_names


def test_the_code_of_an_own_environment_is_in_the_keys(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    made = EnvConfig("maze", "discrete", "maze_of_test:Maze-v0")

    def key(text, file="maze_of_test.py"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
        importlib.invalidate_caches()
        _code_sha256.cache_clear()  # a process reads a module once
        return made.settings()["code_sha256"]

    first = key("reward = 1.0")
    assert first == made.settings()["code_sha256"] == key("reward = 1.0") != key("reward = 7.0")
    (tmp_path / "maze_of_test.py").unlink()
    package = key("", "maze_of_test/__init__.py")
    assert key("reward = 1.0", "maze_of_test/rewards.py") != package
    inner = EnvConfig("maze", "discrete", "maze_of_test.rewards:Maze-v0")
    assert inner.settings() | {"id": made.id} == made.settings()  # what else the package has may be imported by it
    helped = key("import numpy as np\nfrom helper_of_test import f", "maze_of_test/rewards.py")
    beside = key("import maze_of_test", "helper_of_test.py")  # in a circle
    assert helped != beside != key("import maze_of_test, os", "helper_of_test.py")
    assert key("def broken(:", "helper_of_test.py") is not None
    loose = EnvConfig("maze", "discrete", "loose_of_test.mazes:Maze-v0")  # a package without an __init__.py
    key('gym.register("Maze-v0", entry_point="beside_of_test.deep:Maze")', "loose_of_test/mazes.py")
    first = loose.settings()["code_sha256"]
    key("reward = 1.0", "beside_of_test/deep.py")  # as the package beside it is, which is only named as text
    second = loose.settings()["code_sha256"]
    key("reward = 7.0", "beside_of_test/deep.py")
    assert len({first, second, loose.settings()["code_sha256"], None}) == 4
    key("", "loose_of_test/mazes.py")
    assert loose.settings()["code_sha256"] not in (first, second, None)
    assert EnvConfig("gone", "discrete", "no_such_module:Maze-v0").settings()["code_sha256"] is None
    assert "code_sha256" not in EnvConfig("CartPole-v1", "discrete", "CartPole-v1").settings()


def test_code_and_custom_names_are_in_the_keys_of_every_stage_that_plays_or_prints():
    config = dataclasses.replace(job(CART, "method=viper").config, program_text="force = 0.0")
    for stage in (TRAIN, IMITATE, PARSE, PRUNE):
        assert stage.keyed(config)["env"]["code_sha256"] == config.env.settings()["code_sha256"]
    assert IMITATE.keyed(job("env=hopper", "method=viper").config)["env"] == {"id": "Hopper-v4", "kwargs": {}}
    config = job("env=hopper", "depth=2").config
    renamed = dataclasses.replace(config, env=dataclasses.replace(config.env, action_names=["a", "b", "c"]))
    own = dataclasses.replace(config, env=dataclasses.replace(config.env, name="mine"))  # no file of conf/env
    for stage in (PRUNE, CERTIFY, POLISH, SIMPLIFY):
        assert "action_names" not in stage.keyed(config)
        assert stage.keyed(renamed)["action_names"] == ["a", "b", "c"]
        assert stage.keyed(own)["feature_names"] == config.env.feature_names


def test_methods_budgets_and_arguments_of_custom_environments():
    for method, budget in zip(("linear", "viper", "sdt", "pid"), ("smoke", "quick", "standard", "thesis"), strict=True):
        depth = ["depth=0"] * (method == "linear")
        assert job("env=Acrobot-v1", f"method={method}", f"budget={budget}", *depth).config.train.steps > 0
    assert job(f"env={MODULE}:SaidToBeNoisy-v0", "depth=2").config.env.action_names == ["force"]
    heavy = job(CART, "+env.kwargs.mass=2.0")
    assert heavy.config.env.kwargs == {"mass": 2.0} and "~" in heavy.folder


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("env=cartpole",), "there is no such environment. Did you mean CartPole-v1"),
        (("env=xyzzy",), "besides, any registered id, as CartPole-v1$"),
        (("env=Kart-v0",), "Where a module of yours registers it: env=my_module:Kart-v0"),
        (("env=CartPole-v7",), "Did you mean CartPole-v1"),
        (("env=no_such_module:Cart-v0",), "module no_such_module cannot be imported: there is no such module"),
        ((f"env={MODULE}:Card-v0",), f"Environment `Card` doesn't exist. Did you mean {MODULE}:Cart-v0"),
        (("env=ALE/Pong-v5",), "no such environment. There are: ant, .*; besides, any registered id, as CartPole-v1"),
        (("env=Hopper-v9",), "Did you mean Hopper-v5 or Hopper-v4"),
        ((f"env={MODULE}:Images-v0",), "are images, .* out of scope. Accepted is"),
        ((f"env={MODULE}:Words-v0",), r"the observations are Text\(.*, which no vector of one length holds"),
        ((f"env={MODULE}:Keys-v0",), r"the actions are MultiDiscrete.* one of 4 labels, by a gymnasium.ActionWrapper"),
        ((f"env={MODULE}:Unseeded-v0",), r"reset\(seed=0\) gives .* and, again, .* draw from self.np_random"),
        ((f"env={MODULE}:Noisy-v0",), r"the first step after it gives .* and, again, .* with nondeterministic=True"),
        ((f"env={MODULE}:Boundless-v0",), "with limits"),
        ((f"env={MODULE}:Endless-v0",), "episodes have no limit, so one may never end; give one as"),
        (("env=CartPole-v1", "env.feature_names=[a,b]"), "env.feature_names has 2 names, the policy has 4"),
        (("env=CartPole-v1", "env.feature_names=[a,b,c,a]"), "env.feature_names has 'a' twice"),
        (
            ("env=CartPole-v1", "env.feature_names=[a,b,c,d]", "env.action_names=[e,a]"),
            "a feature and an action are both named 'a'",
        ),
        ((CART, "depth=0", "env.kwargs.mass=3"), r"env.kwargs has no 'mass' to change; to give it one: \+env.kwargs"),
        (("env=phys2d/CartPole-v1", "+env.kwargs.wheels=3"), "cannot be made"),
        (("env=Pendulum-v1", "+env.kwargs.g=inf"), "env.kwargs.g=inf: expected finite numbers"),
        (("env=pendulum", "+env.kwargs.g=heavy"), r"environment Pendulum-v1: step\(action\) fails: TypeError"),
    ],
)
def test_what_is_refused_before_anything_runs(words, told):
    with pytest.raises(ConfigError, match=told):
        job(*words)


def test_a_dictionary_is_flattened_and_labels_begin_at_zero(tmp_path):
    words = (f"env={MODULE}:Keyed-v0", "depth=2", "budget=smoke", "n_workers=1", "evaluate.n_episodes=3", "algo=ars")
    done = otr_command("otr-run", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    (run,) = tmp_path.glob("results/runs/*Keyed-v0/otr/depth-2/smoke-ars/seed-0*")
    assert otr.load(run / "map/tree").n_inputs == 3
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["env"]["feature_names"] == ["on_right0", "on_right1", "speed"]


def test_a_mistake_in_an_environment_is_told_with_its_line(command, tmp_path):
    failed = command("run", f"env={MODULE}:FailsLater-v0", "depth=1", "budget=smoke", f"results_dir={tmp_path}")
    assert failed.returncode == 1
    lines = Path("tests/pipelines/own_envs.py").read_text().splitlines()
    number = 1 + next(i for i, line in enumerate(lines) if 'KeyError("goal")' in line)
    assert re.search(rf"KeyError: 'goal' \(.*own_envs\.py, line {number}, in step\)", failed.stderr.replace("\n", " "))


@pytest.mark.parametrize(
    ("env_id", "algorithm", "message"),
    [
        ("NoReward-v0", "ars", r"the rewards of the episode of seed \d+ add up to nan"),
        ("NotFiniteLater-v0", "ars", r"the observation of the episode of seed \d+ at step \d+ is not finite: \[.*nan"),
        ("NotFiniteLater-v0", "sac", r"step [\d,]+: the environment's observations are not finite"),
        ("NotFiniteLater-v0", "ppo", r"step [\d,]+: the environment's observations are not finite"),
    ],
)
def test_what_is_no_number_is_reported(command, tmp_path, env_id, algorithm, message):
    words = (f"env={MODULE}:{env_id}", "method=linear", "depth=0", f"algo={algorithm}", "budget=smoke")
    failed = command("run", *words, f"results_dir={tmp_path}")
    assert failed.returncode == 1 and re.search(message, failed.stderr), failed.stderr
