"""polishing.by=critic: oracle, student and polish in one command; whose critics they are, and when they are read."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC, TD3

import otr
from benchmarks import shrink
from otr.control.settings import CriticPolishSettings
from pipelines.cli.pack import pack_results
from pipelines.cli.runs import RUN, load_config
from pipelines.config.stages import PolishingConfig
from pipelines.engine.stage import stage_status
from pipelines.engine.store import read_json
from pipelines.errors import ConfigError
from pipelines.play.actor_files import load_actor
from pipelines.report.figures.learning_curves import STEPS, load_curves
from pipelines.runs.below_random import random_returns
from pipelines.runs.replay import replay
from pipelines.runs.stage_table import stages_of
from pipelines.stages.polish import POLISH, estimated_seconds, improve_by_critic, polish_keys, polishes_by
from pipelines.training.critics import CRITICS
from tests.committed import copy_run
from tests.pipelines.conftest import otr_succeeds

torch.set_num_threads(1)
SHORT = (
    "budget=smoke", "n_workers=1", "polish=true", "polishing.n_selection_episodes=4", "polishing.n_candidates=2",
    "polishing.critic.batch_size=32",
)  # fmt: skip
FLEET = ("env=pendulum", "trainer=fleet", "algo.critic=[16]")


def run(folder, *words):
    done = otr_succeeds("otr-run", *SHORT, *words, cwd=folder)
    return done.stdout


@pytest.fixture(scope="module")
def shrunk(tmp_path_factory):
    """Return a folder with the results of an oracle, its student and the student's polish, and what was printed."""
    folder = tmp_path_factory.mktemp("shrunk")
    words = (*FLEET, "method=distilled_otr", "depth=4", "oracle=[16]")
    return folder, words, run(folder, *words)


def test_oracle_student_and_polish_come_of_one_command(shrunk, monkeypatch):
    folder, words, printed = shrunk
    monkeypatch.chdir(folder)
    (made,) = folder.glob("results/runs/pendulum/distilled_otr/depth-4/smoke-fleet/seed-0~*")
    (oracle,) = folder.glob("results/runs/pendulum/otr/depth-16/smoke-fleet/seed-0~*")
    report, summary = read_json(made / "polish/report.json"), read_json(made / "summary.json")
    assert CRITICS in read_json(oracle / "train/manifest.json")["outputs"]
    counted = ("by", "numbers", "n_numbers", "n_refill_steps", "n_learning_steps", "n_iterations")
    assert [report[name] for name in counted] == ["critic", "network", 24, 200, 20, 20]
    episodes = report["n_episodes_played"]
    assert episodes in (12, 20) and report["n_steps"] == 200 + 20 + 200 * episodes
    assert summary["steps"] == 300 and summary["total_steps"] == 300 + summary["imitate"]["n_steps"] + 220
    assert "learnt by critics in 20 steps after 200 of play" in printed
    is_kept = report["confirmation_return"] is not None
    assert f"polish: {'the best is' if is_kept else 'nothing is kept, no candidate'}" in printed
    imitation = summary["imitate"]["n_steps"]
    all_steps = f"{520 + imitation:,} steps of the environment in all: 300 of the oracle, {imitation:,} of the"
    assert f"{all_steps} imitation, 220 of the actor" in " ".join(printed.split())
    network, tree = load_actor(made / "polish"), otr.load(made / "polish/tree")
    assert network.head == load_actor(made / "imitate").head and network.hidden_widths == (4,)
    X = np.random.default_rng(0).uniform([-1, -1, -8], [1, 1, 8], (100, 3))
    np.testing.assert_allclose(otr.map_network(network).predict(X), network.predict(X), atol=1e-9)
    assert tree.n_leaves == report["n_leaves"] <= 16
    assert replay(load_config(made, 1), made) == 0
    assert "polish: done before" in run(folder, *words)


def test_the_way_of_a_shrunk_policy_is_drawn_by_all_its_steps_and_timed_from_its_oracle(shrunk, monkeypatch):
    folder, *_ = shrunk
    (made,) = folder.glob("results/runs/pendulum/distilled_otr/depth-4/smoke-fleet/seed-0~*")
    summary = read_json(made / "summary.json")
    curves = load_curves([made])
    imitated = 300 + summary["imitate"]["n_steps"]
    assert curves["spent"].tolist() == [imitated, imitated + 216, imitated + 220] and set(curves["unit"]) == {STEPS}
    assert curves["chosen"].sum() == 1 and curves["final"].iloc[0] == summary["polish"]["return_mean"]
    monkeypatch.setenv("OTR_RESULTS_DIR", str(folder / "results"))
    times = summary["polish"]["candidate_seconds"]
    assert len(times) == 3 and times == sorted(times)
    oracle = {"policies": {"oracle": {"return_mean": curves["mean"].iloc[1]}}}
    run = shrink.shrunk_run(made, summary | oracle, "group")
    third = next(i for i, mean in enumerate(curves["mean"]) if share(mean, curves["mean"].iloc[1]) >= 0.9)
    assert run.minutes == (summary["seconds"]["imitate"] + times[third]) / 60
    (entry,) = [each for each in shrink.measure(quick=False) if each.unit == "return"]
    assert entry.value == summary["polish"]["return_mean"]
    assert entry.peer_value == summary["policies"]["oracle"]["return_mean"]


def share(mean, oracle):
    """Return how far a return is from random actions to the oracle's."""
    least = random_returns()["pendulum"]
    return (mean - least) / (oracle - least)


def test_trainer_shrink_is_a_fleet_s_oracle_a_short_imitation_and_a_polish_by_critics(shrunk):
    folder, *_ = shrunk
    words = ("env=pendulum", "trainer=shrink", "algo.critic=[16]", "oracle=[16]", "depth=3")
    printed = run(folder, *words, "method=distilled_otr", "imitate.n_episodes=1")
    assert "numbers of the network learnt by critics" in printed
    (made,) = folder.glob("results/runs/pendulum/distilled_otr/depth-3/smoke-shrink/seed-0~*")
    assert read_json(made / "imitate/report.json")["n_rows"] == 5 * 200
    assert "/smoke-fleet/seed-0~" in read_json(made / "oracle/oracle.json")["folder"]
    (job,) = RUN.jobs([["env=ant", "method=distilled_experts", "trainer=shrink"]])
    assert job.run_dir.parts[-2:] == ("standard-shrink", "seed-0") and job.config.algo.name == "sac"
    assert job.oracle.run_dir.parts[-3:] == ("depth-256-256", "standard-fleet", "seed-0")
    with pytest.raises(ConfigError, match="trainer=shrink makes a small policy out of a large one, which method=ndps"):
        RUN.jobs([["env=pendulum", "method=ndps", "trainer=shrink"]])


def test_a_program_that_was_trained_soft_is_polished_by_its_own_critics(tmp_path):
    printed = run(tmp_path, "env=pendulum", "method=pi_prl", "depth=2", "algo=sac", "trainer=fleet", "algo.critic=[16]",
                  "polishing.by=critic")  # fmt: skip
    assert "520 steps of the environment in all: 300 of the training, 220 of the actor" in " ".join(printed.split())
    (made,) = tmp_path.glob("results/runs/pendulum/pi_prl/depth-2/smoke-fleet/seed-0~*")
    assert [read_json(made / "polish/report.json")[name] for name in ("by", "numbers")] == ["critic", "tree"]


def test_an_oracle_that_is_shrunk_has_a_budget_of_its_own_where_the_task_has_one():
    shrink = ["env=bipedalwalker", "method=distilled_otr", "trainer=shrink", "depth=6"]
    own, given, others = RUN.jobs(
        [shrink, [*shrink, "train.steps=7"], [word.replace("shrink", "fleet") for word in shrink]]
    )
    steps = own.config.budget.shrink["bipedalwalker"]["steps"]
    assert steps < own.config.budget.steps["bipedalwalker"] == others.oracle.config.train.steps
    assert (own.config.changes, own.oracle.config.changes) == ("", f"train.steps={steps}")
    assert own.config.imitate.n_rounds == own.config.budget.shrink["bipedalwalker"]["n_rounds"] != 4
    assert given.config.changes == given.oracle.config.changes == "train.steps=7"


def test_what_is_packed_without_critics_stays_done_and_its_oracle_is_trained_again_for_another_polish(shrunk, tmp_path):
    folder, words, _ = shrunk
    shutil.copytree(folder / "results", tmp_path / "results")
    pack_results(tmp_path / "results")
    (made,) = tmp_path.glob("results/runs/pendulum/distilled_otr/depth-4/smoke-fleet/seed-0~*")
    assert not (made / "polish").exists() and not list(tmp_path.rglob(CRITICS))
    assert "polish: done before" in run(tmp_path, *words)
    (oracle,) = tmp_path.glob("results/runs/pendulum/otr/depth-16/smoke-fleet/seed-0~*")
    actor = load_actor(oracle / "train")
    plan = otr_succeeds("otr-plan", *SHORT, *words, "polishing.critic.noise=0.2", cwd=tmp_path).stdout
    assert "run, train oracle pendulum/otr/depth-16" in " ".join(plan.split())
    printed = run(tmp_path, *words, "polishing.critic.noise=0.2")
    assert f"train: kept without {CRITICS}, as archives are; done again" in printed
    assert "learnt by critics" in printed and (oracle / "train" / CRITICS).is_file()
    for one, other in zip(actor.weights, load_actor(oracle / "train").weights, strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_actor_is_polished_by_its_own_critics_and_a_tree_by_its_oracle_s(shrunk):
    folder, *_ = shrunk
    assert "numbers of the network learnt by critics" in run(folder, *FLEET, "depth=3", "polishing.by=critic")
    assert "searched" in run(folder, *FLEET, "depth=3", "polishing.n_directions=2", "polishing.n_top=2")
    printed = run(folder, *FLEET, "method=ndps", "depth=2", "oracle=[16]", "method.n_updates=20", "simplify=true")
    assert "numbers of the tree learnt by critics" in printed
    (made,) = folder.glob("results/runs/pendulum/ndps/depth-2/smoke-fleet/seed-0~*")
    before, after = (otr.load(made / stage / "tree") for stage in ("prune", "polish"))
    np.testing.assert_array_equal(before.children_left, after.children_left)
    (oracle,) = folder.glob("results/runs/pendulum/otr/depth-16/smoke-fleet/seed-0~*")
    config = dataclasses.replace(load_config(made, 1), results_dir="/", folder=str(oracle)[1:])
    with pytest.raises(ConfigError, match=r"leads into their box, not Identity; use polishing\.by=search"):
        improve_by_critic(before.replace(head=otr.Identity()), config)
    soft = run(folder, "method=sdt", *FLEET, "algo=sac", "depth=2", "polishing.by=critic")
    assert "numbers of the tree learnt by critics" in soft


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_a_zip_is_an_oracle_with_critics(algorithm, tmp_path):
    policy = {"net_arch": {"pi": [8], "qf": [16, 16]}}
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=policy, learning_starts=50, seed=0)
    model.learn(100).save(tmp_path / "policy.zip")
    words = ("env=pendulum", "method=distilled_otr", "oracle=policy.zip", "depth=6")
    assert "numbers of the network learnt by critics in 20 steps" in run(tmp_path, *words)
    (made,) = tmp_path.glob("results/runs/pendulum/distilled_otr/depth-6/smoke/seed-0~*")
    summary = json.loads((made / "summary.json").read_text())
    assert summary["total_steps"] == summary["imitate"]["n_steps"] + 220 and summary["model"] == "policy.zip"
    assert "learnt by critics" in run(tmp_path, "env=pendulum", "model=policy.zip", "polishing.by=critic")


def test_where_there_are_no_critics_a_search_polishes(tmp_path):
    relu = {"net_arch": [8], "activation_fn": torch.nn.ReLU}
    PPO("MlpPolicy", "Pendulum-v1", policy_kwargs=relu, n_steps=64, seed=0).save(tmp_path / "policy.zip")
    words = ("env=pendulum", "method=distilled_otr", "oracle=policy.zip", "depth=2")
    assert "searched" in run(tmp_path, *words, "polishing.n_directions=2", "polishing.n_top=2")


@pytest.mark.parametrize("words", [
    ("env=pendulum", "method=distilled_otr", "trainer=sb3"),
    ("env=lunarlander", "budget=quick"),
    ("env=mountaincar", "program=mountaincar"),
])  # fmt: skip
def test_critics_that_nobody_has_are_not_asked_for(words):
    with pytest.raises(ConfigError, match=r"polishing\.by=critic needs the critics .* trainer=fleet with algo=sac"):
        RUN.jobs(RUN.expand([*words, "polish=true", "polishing.by=critic"], False))


def test_committed_polishes_keep_their_keys(tmp_path):
    committed = "pendulum/ndps/depth-6/standard-fleet/seed-0"
    made = tmp_path / "results/runs" / committed
    copy_run(committed, made)
    config = dataclasses.replace(load_config(made, 1), results_dir=str(tmp_path / "results"))
    assert polishes_by(config) == "search"
    assert stage_status(POLISH, made / "polish", config) == "done"
    keyed = polish_keys(config)["polishing"]
    assert not {"by", "critic", "scale"} & set(keyed) and keyed["n_directions"] == config.polishing.n_directions
    # What is set for critics alone does not change it, and a polish by critics hears of nothing else.
    other = dataclasses.replace(config.polishing, critic=dataclasses.replace(config.polishing.critic, noise=0.3))
    assert stage_status(POLISH, made / "polish", dataclasses.replace(config, polishing=other)) == "done"
    by_critic = dataclasses.replace(config, polishing=PolishingConfig(by="critic"))
    assert stage_status(POLISH, made / "polish", by_critic) == "other settings"
    searched = dataclasses.replace(by_critic, polishing=PolishingConfig(by="critic", n_directions=20, steps=3))
    assert polish_keys(searched) == polish_keys(by_critic)
    wide = PolishingConfig(by="critic", critic=CriticPolishSettings(first_neurons=40))  # a tree has no neurons
    assert polish_keys(dataclasses.replace(by_critic, polishing=wide)) == polish_keys(by_critic)
    assert wide.settings_by_critic(of_network=True)["first_neurons"] == 40
    assert stages_of("ndps")["polish"].inputs == ("prune",)
    assert 240 < estimated_seconds(by_critic) < 600


def test_a_plan_knows_that_an_oracle_to_come_will_have_critics(tmp_path):
    words = ("env=pendulum", "method=distilled_otr", "polish=true", f"results_dir={tmp_path}")
    seconds = {}
    for own in (("trainer=fleet",), ("trainer=fleet", "polishing.by=search"), ("trainer=sb3",)):
        (job,) = RUN.jobs(RUN.expand([*words, *own], False))
        seconds[own] = estimated_seconds(job.config)
    by_critic, searched, without = seconds.values()
    assert by_critic > 240 and searched == without < 60
