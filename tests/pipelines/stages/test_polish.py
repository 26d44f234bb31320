"""polish=true: what it leaves, what certify and simplify make of it, and who shows it."""

import dataclasses
import json

import numpy as np
import pytest

import otr
from otr.shorten.simplify import Simplification
from pipelines.cli.runs import RUN, load_config
from pipelines.config.env import EnvConfig
from pipelines.config.methods import METHODS, ProgramConfig, ViperConfig
from pipelines.config.stages import EvaluateConfig, PolishingConfig, PruneConfig, SimplificationConfig
from pipelines.engine.seeding import episode_seeds
from pipelines.engine.store import read_csv, read_json
from pipelines.errors import ConfigError
from pipelines.play.actor_files import load_actor
from pipelines.play.spaces import spaces
from pipelines.runs.replay import replay
from pipelines.runs.result import _loss
from pipelines.runs.run_job import RunJob
from pipelines.runs.stage_table import stages_of
from pipelines.stages import simplify as simplify_module
from pipelines.stages.polish import announce_polish, environments, estimated_seconds, polish
from tests.committed import copy_run
from tests.pipelines.conftest import HOPPER, LANDER, PENDULUM

PENDULUM_RUN = "pendulum/otr/depth-6/quick/seed-0"
MOUNTAIN_CAR = EnvConfig("mountaincar", "mountaincar", "MountainCarContinuous-v0")
# 4 iterations of 16 policies on 32 starts: 0.4 million steps of the pendulum in numpy
SHORT = PolishingConfig(
    steps=400_000, n_directions=8, n_top=8, step_size=0.3, noise=0.1, n_episodes=32, common_starts="all",
    n_selection_episodes=200, n_candidates=2,
)  # fmt: skip
SHORT_WORDS = [
    *(f"polishing.{name}={getattr(SHORT, name)}" for name in ("steps", "n_directions", "n_top", "n_episodes")),
    "polishing.n_selection_episodes=200", "polishing.n_candidates=2",
]  # fmt: skip


@pytest.fixture
def results(tmp_path):
    """Return a results folder with the committed run of the pendulum, without its extra stages."""
    copy_run(PENDULUM_RUN, tmp_path / "results/runs" / PENDULUM_RUN, "polish", "certify", "simplify")
    return tmp_path / "results"


def pendulum(command, results, *words):
    done = command("run", "env=pendulum", "depth=6", "budget=quick", "n_workers=1", f"results_dir={results}", *words)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def linear(tmp_path, gain: float):
    """Write the pruned tree of the policy `torque = gain * angle_rate`."""
    M = np.array([[[0.0, 0.0, gain]]])
    otr.save(
        otr.ObliqueTree([], [], np.zeros((0, 3)), [], M, [[0.0]], head=otr.ClipBox([-2.0], [2.0])), tmp_path / "tree"
    )


def test_a_tree_of_any_method_is_polished_and_what_is_zero_stays(tiny, tmp_path):
    folder, out = tmp_path / "prune", tmp_path / "out"
    for each in (folder, out):
        each.mkdir()
    linear(folder, 0.1)
    config = tiny(
        method=ViperConfig("viper", max_samples=100),
        prune=PruneConfig(5, None),
        evaluate=EvaluateConfig(20, 1000),
        polishing=SHORT,
    )
    polish({"prune": folder}, config, out)
    assert sorted(path.name for path in out.iterdir()) == [
        "candidates.csv", "episodes.csv", "program.txt", "report.json", "tree.json", "tree.npz",
    ]  # fmt: skip
    report = read_json(out / "report.json")
    tree = otr.load(out / "tree")
    assert report["kept"] and report["numbers"] == "tree" and report["n_numbers"] == 1 == np.count_nonzero(tree.M)
    assert tree.M[0, 0, 2] != 0.1 and tree.c[0, 0] == 0.0
    assert report["n_iterations"] == 4 and report["n_steps"] == 200 * report["n_episodes_played"]
    assert report["n_episodes_played"] == 4 * 16 * 32 + 3 * 200 + 2 * 200
    assert report["selection_return"] > report["selection_return_before"] + 10
    assert report["confirmation_return"] > report["confirmation_return_before"] + 10
    assert report["best_iteration"] in (2, 4)
    candidates = [(int(row["iteration"]), float(row["selection_mean"])) for row in read_csv(out / "candidates.csv")]
    assert [iteration for iteration, _ in candidates] == [0, 2, 4]
    assert max(mean for _, mean in candidates) == report["selection_return"]
    returns = [float(row["return"]) for row in read_csv(out / "episodes.csv")]
    assert np.mean(returns) == pytest.approx(report["return_mean"]) and len(returns) == 20 == report["n_episodes"]
    assert report["return_mean"] == report["return_mean_pruned"] > report["return_mean_before"]
    again = tmp_path / "again"
    again.mkdir()
    polish({"prune": folder}, config, again)
    assert (again / "tree.npz").read_bytes() == (out / "tree.npz").read_bytes()
    assert (again / "candidates.csv").read_bytes() == (out / "candidates.csv").read_bytes()


def test_a_scale_by_sensitivity_reports_its_size_and_is_keyed(tiny, tmp_path):
    folder, out = tmp_path / "prune", tmp_path / "out"
    for each in (folder, out):
        each.mkdir()
    linear(folder, 0.1)
    polishing = dataclasses.replace(SHORT, scale="sensitivity", steps=100_000)
    config = tiny(method=ViperConfig("viper", max_samples=100), polishing=polishing)
    polish({"prune": folder}, config, out)
    report = read_json(out / "report.json")
    assert report["size"] in [8.0 / 2**n for n in range(13)]
    assert report["n_iterations"] == 1 and report["n_numbers"] == 1
    n_sets = 3 + np.log2(8.0 / report["size"])  # of 16 policies: the start, each size, the iteration
    n_chosen = 2 if report["confirmation_return"] is None else 4
    assert report["n_episodes_played"] == n_sets * 16 * 32 + n_chosen * 200
    assert config.settings()["polishing"]["scale"] == config.polishing.settings()["scale"] == "sensitivity"


@pytest.mark.parametrize(("words", "told"), [
    (("env=lunarlander", "budget=quick"), "is for continuous actions, and those of LunarLander-v3 are labels"),
    (("env=pendulum", "method=distilled_otr", "trainer=fleet"), "is of a search, and critics polish this run"),
])  # fmt: skip
def test_a_scale_by_sensitivity_is_refused_before_anything_is_done(words, told, tmp_path):
    words = [*words, "polish=true", "polishing.scale=sensitivity", f"results_dir={tmp_path}"]
    (job,) = RUN.jobs(RUN.expand(words, False))
    with pytest.raises(ConfigError, match=told):
        RUN.check(job.config)
    if "method=distilled_otr" in words:
        (searched,) = RUN.jobs(RUN.expand([*words, "polishing.by=search"], False))
        RUN.check(searched.config)


def test_a_mapped_tree_is_polished_as_its_network_proved_and_exported(command, results, capsys):
    run = results / "runs" / PENDULUM_RUN
    printed = pendulum(command, results, "polish=true", "certify=true", *SHORT_WORDS)
    (run,) = run.parent.glob("seed-0~*")
    report, network = read_json(run / "polish/report.json"), load_actor(run / "polish")
    assert report["numbers"] == "network" and report["n_numbers"] == 31
    assert "polished: 31 numbers of the network searched in" in printed and "│ polished " in printed
    trained = load_actor(run / "train")
    assert network.head == trained.head and network.hidden_widths == (6,)
    assert report["kept"] == (not np.array_equal(network.weights[0], trained.weights[0]))
    assert replay(load_config(run, 1), run) == 0
    assert f"{run}: polished: 5,000 episodes played again, as recorded" in capsys.readouterr().out
    tree = otr.load(run / "polish/tree")
    X = np.random.default_rng(0).uniform(*spaces(PENDULUM).states, (2000, 3))
    same = np.isclose(otr.map_network(network).predict(X), network.predict(X), atol=1e-9).all()
    assert same and tree.n_leaves == report["n_leaves"] <= 64
    # The certificate is of the polished network, and is refused with the trained one.
    about = read_json(run / "certify/report.json")
    assert about["policy"] == "polished" and about["certified"]
    assert "is the polished network" in printed or "is exactly the polished network" in printed
    assert command("verify", f"run={run}").stdout.startswith("verified")
    refused = command("verify", f"run={run}", f"actor={run / 'train'}")
    assert refused.returncode == (1 if report["kept"] else 0)
    exported = command("export", f"run={run}", "format=text", "tree=polished")
    assert exported.stdout == (run / "polish/program.txt").read_text()
    assert "polish: done before" in pendulum(command, results, "polish=true", "certify=true", *SHORT_WORDS)
    # Without polish=true the certificate is of the trained network again.
    pendulum(command, results, "certify=true", *SHORT_WORDS)
    assert "policy" not in read_json(run / "certify/report.json")
    assert read_json(run / "summary.json")["polish"] == report


def test_certify_and_simplify_read_the_polish_where_there_is_one():
    for method, config in METHODS.items():
        plain, polished = stages_of(method), stages_of(method, polished=True)
        assert plain["certify"].inputs == (config.actor_stage, "map") and plain["simplify"].inputs == ("prune",)
        assert polished["certify"].inputs == polished["simplify"].inputs == ("polish",)
        assert plain["polish"].inputs == ((config.actor_stage, "prune") if config.is_mapped else ("prune",))


def test_what_is_listed_beside_polish_is_of_the_polished_policy(tiny):
    for asked in ({"polish": True, "certify": True}, {"stages": ["polish", "certify"]}):
        *_, certify = RunJob(tiny(**asked), "runs/one", "").stages
        assert certify.inputs == ("polish",)
    for by_recipe, inputs in ((True, ("polish",)), (False, ("train", "map"))):  # a budget's recipe may have polish=true
        (certify,) = RunJob(tiny(stages=["certify"], polish=by_recipe), "runs/one", "").stages
        assert certify.inputs == inputs


def test_a_program_is_polished_shortened_and_polished_again(command, tmp_path):
    (tmp_path / "car.txt").write_text("if velocity <= 0.001 position: -0.9 else: 0.8 + 0.0001 position\n")
    words = (
        "env=mountaincar", f"program={tmp_path / 'car.txt'}", "budget=quick", "n_workers=1", "polish=true",
        "simplify=true", f"results_dir={tmp_path / 'results'}", "polishing.steps=20_000",
        "polishing.n_directions=8", "polishing.n_top=4", "polishing.n_selection_episodes=20",
        "polishing.n_candidates=4", "simplification.n_episodes=20", "evaluate.n_episodes=20",
    )  # fmt: skip
    done = command("run", *words)
    assert done.returncode == 0, done.stdout + done.stderr
    (run,) = (tmp_path / "results").glob("runs/mountaincar/program/depth-1/quick/seed-0~*")
    polished, simplified = (read_json(run / stage / "report.json") for stage in ("polish", "simplify"))
    assert polished["kept"] and polished["return_mean"] > polished["return_mean_before"]
    assert simplified["return_mean_before"] == polished["return_mean"]
    again = simplified["polished_again"]
    assert simplified["n_numbers"] < simplified["n_numbers_before"]
    assert again["n_numbers"] <= simplified["n_numbers"]
    if not again["kept"]:
        assert again["return_mean_before"] == simplified["return_mean"]
    tree = otr.load(run / "simplify/tree")
    actions = tree.predict(np.random.default_rng(0).uniform(*spaces(MOUNTAIN_CAR).states, (500, 2)))
    assert np.abs(actions).max() <= 1.0
    assert "polished again: " in done.stdout
    loss = simplified["loss"]
    assert loss["n_episodes"] == 20 and loss["mean"] <= loss["standard_error"] > 0
    assert "the shorter program loses nothing on 20 episodes that decided nothing: " in done.stdout
    # The recorded episodes of the polished policy come back.
    words = ("tabulate", "runs", "evaluate=true", f"results_dir={tmp_path / 'results'}", "n_workers=1")
    replayed = command(*words)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
    assert f"{run}: polished: 20 episodes played again, as recorded" in replayed.stdout
    assert command("export", f"run={run}", "format=text", "tree=polished").returncode == 0
    recorded = (run / "polish/episodes.csv").read_text()
    (run / "polish/episodes.csv").write_text(recorded.replace("\n3,1003,", "\n3,1003,1"))
    replayed = command(*words)
    assert replayed.returncode == 1 and "polished: 20 episodes played again, 1 differ, the first is episode 3" in (
        replayed.stdout
    )


def test_a_shorter_tree_that_loses_after_its_second_polish_is_searched_for_again(tiny, tmp_path, monkeypatch):
    folder, out, spins = tmp_path / "polish", tmp_path / "out", tmp_path / "spins"
    for each in (folder, out, spins):
        each.mkdir()
    linear(folder, 0.0)
    linear(spins, -1.0)
    worse = otr.load(spins / "tree")
    allowed, n_worse = [], [2]

    def attempt(tree, judge, states, refit):
        allowed.append(judge.allowed)
        return Simplification(worse if len(allowed) <= n_worse[0] else tree, 4, 3, 2, 1)

    monkeypatch.setattr(simplify_module.otr, "simplify", attempt)
    monkeypatch.setattr(simplify_module, "_polished_again", lambda simpler, config: (simpler, {"polished_again": {}}))
    config = tiny(method=ViperConfig("viper", max_samples=100), simplification=SimplificationConfig(n_episodes=10))
    for n_worse[0], n_attempts in ((2, 3), (9, 4)):
        allowed.clear()
        simplify_module.simplify({"polish": folder}, config, out)
        report = read_json(out / "report.json")
        assert report["n_attempts"] == n_attempts == len(allowed)
        assert allowed == [allowed[0] / 2**i for i in range(n_attempts)]
        loss, kept = report["loss"], otr.load(out / "tree")
        assert loss == {"mean": 0.0, "standard_error": 0.0, "n_episodes": 10} and kept.M[0, 0, 2] == 0.0
        assert _loss(loss) == "the shorter program loses nothing on 10 episodes that decided nothing: +0.00 ± 0.00"
        # Where all attempts lose, none is kept.
        was_kept = n_attempts == 3
        assert (report["n_kept"], report["n_numbers"]) == ((1, 3) if was_kept else (0, 4))
        assert ("polished_again" in report) is was_kept
    worse_loss = {"mean": 2.0, "standard_error": 0.5, "n_episodes": 10}
    assert _loss(worse_loss) == "the shorter program loses 2.00 ± 0.50 on 10 episodes that decided nothing"
    # Four sets of episodes, of which no two share a seed, decide, check, measure the loss and are reported.
    sets = [episode_seeds(0, "simplify", 10, index) for index in range(3)]
    assert len({seed for seeds in sets for seed in seeds}) == 30


def test_a_long_polish_is_announced_and_planned(command, tiny, tmp_path, capsys):
    # 1,000,000 steps of the search, 23 times 100 episodes of half the longest length, at 18,000 steps/s
    lander = tiny(env=LANDER)
    assert estimated_seconds(lander) == pytest.approx((1_000_000 + 2_300 * 500) / 18_000)
    # In numpy the mountain car is fast, in gymnasium it is not.
    assert estimated_seconds(tiny(env=MOUNTAIN_CAR)) == pytest.approx((1_000_000 + 2_300 * 999 / 2) / 300_000)
    slow = PolishingConfig(environments="gymnasium")
    assert estimated_seconds(tiny(env=MOUNTAIN_CAR, polishing=slow)) == pytest.approx((1_000_000 + 1_148_850) / 8_000)
    announce_polish([lander])
    announce_polish([tiny(env=MOUNTAIN_CAR)])
    assert capsys.readouterr().out == (
        "polish: a search of 1,000,000 steps, about 2 min on one core; if stopped, it starts over\n"
    )
    run = "lunarlander/augtree/depth-2/quick/seed-0"
    copy_run(run, tmp_path / "runs" / run, "polish", "certify", "simplify")
    oracle = "lunarlander/otr/depth-256/quick/seed-0"
    copy_run(oracle, tmp_path / "runs" / oracle)
    words = ("env=lunarlander", "method=augtree", "depth=2", "polish=true", f"results_dir={tmp_path}")
    assert "run polish  2 min" in command("plan", *words, "budget=quick").stdout
    planned = " ".join(command("plan", *words).stdout.split())
    assert "polish for about 2 min" in planned and "23 min" in planned


def test_labels_are_polished(command, tmp_path):
    (tmp_path / "fall.txt").write_text("if y_velocity < -0.2 then main_engine else none\n")
    words = ("env=lunarlander", f"program={tmp_path / 'fall.txt'}", "budget=smoke", "n_workers=1", "polish=true",
             "polishing.n_directions=2", "polishing.n_top=2", f"results_dir={tmp_path}")  # fmt: skip
    assert command("run", *words).returncode == 0
    (report,) = tmp_path.glob("runs/lunarlander/program/depth-1/smoke/seed-0~*/polish/report.json")
    assert json.loads(report.read_text())["n_numbers"] == 2


def test_a_pid_policy_is_polished_as_its_network_or_as_its_tree_with_constant_gains(tmp_path):
    run = tmp_path / "run"
    copy_run("pendulum/pid/depth-1/quick/seed-0", run, "polish", "certify", "simplify")
    config = dataclasses.replace(
        load_config(run, 1), prune=PruneConfig(2, None), evaluate=EvaluateConfig(2, 1000),
        polishing=PolishingConfig(steps=1, n_directions=2, n_top=2, n_selection_episodes=2, step_size=0.01, noise=0.01),
    )  # fmt: skip
    for numbers in ("network", "tree"):
        out = tmp_path / numbers
        out.mkdir()
        polishing = dataclasses.replace(config.polishing, numbers=numbers)
        inputs = {"train": run / "train", "prune": run / "prune"}
        polish(inputs, dataclasses.replace(config, polishing=polishing), out)
        assert read_json(out / "report.json")["numbers"] == numbers
    network, trained = load_actor(tmp_path / "network"), load_actor(run / "train")
    np.testing.assert_array_equal(network.weights[-1][:9], trained.weights[-1][:9])  # the terms P, I, D
    assert (tmp_path / "network/constant_gains.txt").is_file()
    assert (
        otr.load(tmp_path / "tree/tree").head == otr.load(run / "prune/constant_gains").head == otr.TanhBox([-2], [2])
    )


def test_settings_that_do_not_go_together_are_refused(tiny):
    viper, by_tree = ViperConfig("viper", max_samples=100), PolishingConfig(numbers="tree")
    for changes, told in (
        ({"method": viper, "polishing": PolishingConfig(numbers="network")}, "method=viper stands for no network"),
        ({"polish": True, "certify": True, "polishing": by_tree}, "polishing.numbers=tree with certify=true"),
        ({"stages": ["polish", "certify"], "polishing": by_tree}, "polishing.numbers=tree with certify=true"),
        ({"method": viper, "polish": True, "certify": True}, "certify=true: a tree of method=viper stands for no"),
        ({"polishing": PolishingConfig(n_top=30)}, "polishing.n_top=30 is more than polishing.n_directions=24"),
    ):
        with pytest.raises(ConfigError, match=told):
            tiny(**changes)


def test_polish_free_is_short_for_polishing_free():
    (job,) = RUN.jobs(RUN.expand(["env=mountaincar", "polish=true", "polish.free=true"], False))
    assert job.config.polish and job.config.polishing.free and "~" in job.folder
    (plain,) = RUN.jobs(RUN.expand(["env=mountaincar", "polish=true"], False))
    assert "~" not in plain.folder


def test_environments_are_numpy_s_where_these_are_gymnasium_s(tiny):
    program = ProgramConfig("program", "x")
    assert environments(tiny(env=PENDULUM, method=program)) == environments(tiny(env=MOUNTAIN_CAR)) == "numpy"
    assert environments(tiny(env=LANDER)) == environments(tiny(env=HOPPER)) == "gymnasium"
    assert environments(tiny(polishing=PolishingConfig(environments="gymnasium"))) == "gymnasium"
    unfit = tiny(env=HOPPER, polish=True, polishing=PolishingConfig(environments="numpy"))
    with pytest.raises(ConfigError, match="environments=numpy: Hopper-v4 is not among those"):
        RUN.check(unfit)  # before anything is done
