"""Jobs that are composed together come out as if each were composed alone, whatever stands for several."""

import pytest
from omegaconf import OmegaConf

from pipelines.cli.compose import Composer, to_object
from pipelines.cli.fits import FIT
from pipelines.cli.runs import RUN
from pipelines.config.methods import METHODS

METHOD_DEPTHS = {name: "depth=[3,3]" if name == "cdt" else "depth=0" if name == "linear" else "depth=4"
                 for name in METHODS if name not in ("program", "model")}  # fmt: skip


def alone(workflow, overrides):
    """Return a configuration and its text as Hydra composes it from all overrides at once."""
    cfg = Composer._compose(workflow, overrides)
    return to_object(cfg), OmegaConf.to_yaml(cfg, resolve=True)


@pytest.mark.parametrize("method", METHOD_DEPTHS)
def test_seeds_depths_and_methods_are_put_in_as_they_are_composed(method):
    env = {"pid": "pendulum", "otr": "lunarlander", "pi_prl": "swimmer"}.get(method, "hopper")
    own = [f"env={env}", f"method={method}", "budget=quick", METHOD_DEPTHS[method]]
    for job in RUN.jobs([[*own, "seed=3"], [*own, "seed=11", "oracle=[8,8]"]]):
        config, yaml = alone(RUN, job.overrides)
        made = job.config
        assert job.config_yaml == yaml
        assert (made.method, made.algo, made.train, made.seed, made.depth, made.oracle) == (
            config.method, config.algo, config.train, config.seed, config.depth, config.oracle)  # fmt: skip
        assert f"/{method}/" in job.folder and f"/seed-{made.seed}" in job.folder


@pytest.mark.parametrize(
    ("workflow", "own", "values"),
    [
        (RUN, ["env=hopper", "algo=sac"], ["algo.gamma=0.9", "algo.critic=[8,8]", "train.steps='${budget.steps.ant}'"]),
        (RUN, ["env=bipedalwalker"], ["train.steps=7", "algo.normalise=false", "n_workers=2"]),
        (RUN, ["env=halfcheetah"], ["depth=[4,4]", "budget.search.ant.steps=9", "results_dir='a, b'", "polish=true"]),
        (RUN, ["env=hopper", "method=viper"], ["method.criterion=entropy", "imitate.n_rounds=3", "oracle=[8]"]),
        (RUN, ["env=pendulum", "method=pid", "+env.kwargs.g=9.0"], ["method.goal=[1,0]", "polishing.n_episodes=3"]),
        (FIT, ["data=bace", "method=cart_taught"], ["method.teacher={n_estimators: 5}", "method.grid=[]", "seed=2"]),
        (FIT, ["data=bace", "method=otr", "data.split=1"], ["method.hidden=[3]", "keep_trees=false"]),
    ],
)
def test_values_are_put_in_as_hydra_does(workflow, own, values):
    (job,) = workflow.jobs([[*values, *own]])
    config, yaml = alone(workflow, [*values, *own])
    assert job.config_yaml == yaml
    assert job.config.settings() == config.settings()


def test_a_single_value_is_a_list_of_one_where_a_list_is_to_be():
    own = ["env=lunarlander", "method=augtree", "depth=3", "budget=quick"]
    one, listed = RUN.jobs([[*own, "oracle=64", "algo.critic=32", "stages=oracle"],
                            [*own, "oracle=[64]", "algo.critic=[32]", "stages=[oracle]"]])  # fmt: skip
    assert one.config == listed.config and one.folder == listed.folder
    assert (one.config.oracle, one.config.algo.critic, one.config.stages) == ([64], [32], ["oracle"])
    swept = RUN.jobs(RUN.expand([*own, "oracle=64,[8,8]"], multirun=True))
    assert [job.config.oracle for job in swept] == [[64], [8, 8]]
    assert len(RUN.expand(["env=lunarlander", "method=otr,viper", "oracle=64"], multirun=True)) == 2  # of one of them
    assert FIT.jobs([["data=breast_cancer", "method=otr", "method.hidden=2"]])[0].config.method.hidden == [2]


@pytest.mark.parametrize(("method", "before"), [("otr", {}), ("cart_taught", {"forest": "random_forest"})])
def test_settings_by_name_are_put_where_none_are(method, before):
    (job,) = FIT.jobs([["data=breast_cancer", f"method={method}", "method.teacher={n_estimators: 5}"]])
    assert job.config.method.teacher.items() >= (before | {"n_estimators": 5}).items()
    (job,) = FIT.jobs([["data=breast_cancer", f"method={method}", "method.teacher=null"]])
    assert job.config.method.teacher is None


def test_settings_that_depend_on_others():
    overrides = ["env=pendulum", "budget=smoke", "evaluate.first_seed='${seed}'"]
    jobs = RUN.jobs([[*overrides, f"seed={seed}"] for seed in (4, 5)])
    assert [job.config.evaluate.first_seed for job in jobs] == [4, 5]
    assert [job.config_yaml.count(f"seed: {seed}") for job, seed in zip(jobs, (4, 5), strict=True)] == [2, 2]
    assert jobs[0].folder.split("~")[1] != jobs[1].folder.split("~")[1]
    linear, given = RUN.jobs([["env=hopper", "method=linear"], ["env=hopper", "method=linear", "depth=0"]])
    assert linear.config == given.config and linear.folder == given.folder
    assert linear.folder.startswith("runs/hopper/linear/depth-0/")
    for env, n_episodes in (("reacher", 1000), ("hopper", 100)):  # a task's episodes stand before the budget's
        assert RUN.jobs([[f"env={env}", "depth=6", "budget=quick"]])[0].config.evaluate.n_episodes == n_episodes


def test_an_experiment_with_settings_of_its_own_names_the_folder():
    own = ["data=breast_cancer", "method=cart"]
    plain, harmless, own_settings = FIT.jobs([own, [*own, "keep_trees=false"], [*own, "+experiment=smoke"]])
    assert plain.folder == harmless.folder == "runs/breast_cancer/cart/seed-0"
    assert own_settings.folder.startswith("runs/breast_cancer/cart/seed-0~")  # it has method.grid=[]


def test_what_hydra_composes_stays_small(monkeypatch):
    composed = []
    monkeypatch.setattr(RUN, "_composed", {})
    original = Composer._compose
    monkeypatch.setattr(Composer, "_compose", lambda self, own: composed.append(own) or original(self, own))
    jobs = RUN.jobs(RUN.expand(["+experiment=table_4_1", "env=hopper,pendulum"], multirun=False))
    assert len(jobs) == 2 * 7 * 10
    assert len(composed) == 2 * 8  # each environment with each method and depth once, whatever the seed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("env=mountaincar", "depth=1", "polishing.steps=2000"),
         "polishing.steps=2000 names the run's folder, and nothing else: add polish=true"),
        (("env=mountaincar", "depth=1", "polishing.steps=2000", "polish=true"), ""),
        (("env=mountaincar", "depth=1", "certification.max_leaves=9"), "nothing else: add certify=true"),
        (("env=mountaincar", "depth=1", "trainer=fleet", "algo=sac"), ""),
        (("env=hopper", "trainer=fleet", "algo=ars"), "env=hopper is trained by direct search with algo=ars\n"),
        (("env=lunarlander", "trainer=fleet"), "env=lunarlander is trained by Stable-Baselines3 with algo=ppo\n"),
        (("env=hopper,swimmer", "trainer=fleet", "algo=td3"), "td3; 2 of 2 jobs are trained without the fleet"),
        (("env=hopper", "method=viper", "trainer=fleet"), ""),
        (("env=hopper", "method=viper", "trainer=fleet", "algo=td3"), "by Stable-Baselines3 with algo=td3\n"),
    ],
)  # fmt: skip
def test_settings_that_change_nothing_and_what_a_fleet_does_not_train_are_reported(words, message, capsys):
    RUN.jobs(RUN.expand(words, multirun=True))
    captured = capsys.readouterr()
    assert captured.out == "" and (message in captured.err if message else captured.err == "")
