"""When a run suggests that a tree imitates its policy, and with which command."""

import dataclasses
import shlex

import numpy as np
import pytest

import otr
from pipelines.cli.overrides import with_path_quoted
from pipelines.cli.runs import RUN, run_config
from pipelines.config.env import EnvConfig
from pipelines.config.model import ImportedModel
from pipelines.runs.imitation import READABLE_LEAVES, advice, imitating_command

NETWORK = otr.ReluNetwork([np.ones((2, 4)), np.ones((2, 2))], [np.zeros(2), np.zeros(2)], head=otr.Argmax())


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("a model") / "policy.json"
    otr.save(otr.PatternTree(NETWORK), path)
    (job,) = RUN.jobs([["env=CartPole-v1", "method=model", f"method.model='{path}'"]])
    return job.config


@pytest.mark.parametrize(
    ("leaves", "told"),
    [
        ({"pruned_leaves": READABLE_LEAVES}, None),
        ({"pruned_leaves": 1234}, "A tree of 1,234 leaves is more than a person reads. Of the methods that imitate"),
        ({"pruned_leaves": 1234, "polish": {"n_leaves": 90, "kept": False}}, "A tree of 90 leaves"),
        ({"pruned_leaves": 1234, "polish": {"n_leaves": 90, "kept": True}, "simplify": {"n_leaves": 5}}, None),
    ],
)
def test_more_leaves_than_people_read(config, leaves, told):
    if told is None:
        assert advice(config, leaves) is None
    else:
        assert advice(config, leaves).startswith(told)
        assert advice(config, leaves).endswith(f"a tree of at most 8 leaves:\n  {imitating_command(config)}")
    assert advice(dataclasses.replace(config, imported=None), leaves) is None


def test_the_command_can_be_given_as_it_is(config):
    program, *words = shlex.split(imitating_command(config))
    assert program == "otr-run"
    words = [with_path_quoted(word) for word in (*words, "++env.kwargs.sutton_barto_reward=True")]
    (job,) = RUN.jobs([RUN.spelt_out(words)])
    imitating = job.config
    assert imitating.env.kwargs == {"sutton_barto_reward": True}
    assert (imitating.method.name, imitating.depth, imitating.oracle) == ("augtree", 3, [2])
    assert imitating.imported.sha256 == config.imported.sha256
    assert advice(imitating, {"pruned_leaves": 1234}) is None


def test_arguments_of_the_environment_and_statistics_are_in_the_command():
    config = run_config(["env=CartPole-v1", "method=model", "method.model=a.zip", "method.normalise=s.pkl"])
    env = EnvConfig("maze", "discrete", "my_module:Maze-v0", {"size": 5})
    config = dataclasses.replace(config, env=env, imported=ImportedModel(NETWORK, "a.zip", "0"))
    assert imitating_command(config) == (
        "otr-run env=my_module:Maze-v0 ++env.kwargs.size=5 method=augtree oracle=a.zip depth=3 normalise=s.pkl"
    )


def test_the_unpolished_policy_is_what_is_imitated(config):
    before = "imitate the policy as it was before the polish"
    for kept in (True, False):
        told = advice(config, {"pruned_leaves": 1234, "polish": {"n_leaves": 90, "kept": kept}})
        assert (before in told) is kept


def test_names_and_the_folder_of_results_are_in_the_command(config):
    names = ["env.feature_names=[a,b,c,d]", "env.action_names=[e,f]"]
    command = imitating_command(dataclasses.replace(config, results_dir="my results"), [*names, "seed=3"])
    assert command.endswith(" 'env.feature_names=[a,b,c,d]' 'env.action_names=[e,f]' 'results_dir=my results'")
