"""Benchmarks: the form of what they write, and the helpers that measure; how fast anything is stays untested here."""

import json
import math
import shutil
from importlib import import_module
from itertools import count

import gymnasium
import numpy as np
import pandas as pd
import pytest

import otr
from benchmarks import (
    control,
    fixed_point,
    latency,
    mapping,
    microcontrollers,
    pendulum_optimum,
    polish,
    search,
    search_curves,
    supervised,
    tables,
    training,
)
from benchmarks.__main__ import NAMES, document, main
from benchmarks.evaluation import STANDING_GAINS, STANDING_OFFSETS, standing_policy
from benchmarks.mapping import copying_tree, random_network
from benchmarks.measure import Entry, alternate, peak_bytes
from pipelines.config.env import EnvConfig
from pipelines.play.episodes import play_seeds
from pipelines.training.search.policy_search import PolicySearch
from tests.committed import RESULTS
from tests.pipelines.conftest import otr_command

ENTRY_KEYS = {"name", "value", "unit", "peer", "peer_value", "ratio", "target", "met", "clock"} | {
    "command", "git_revision", "versions", "machine"}  # fmt: skip


def test_a_benchmark_writes_its_measurements_with_versions_and_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("OTR_RESULTS_DIR", str(tmp_path))
    monkeypatch.setattr(mapping, "measure", lambda quick: [Entry("a tree", 3.0, "s", "a peer", 2.0, "ratio <= 1.2")])
    assert main(["mapping", "--quick"]) == 0
    (entry,) = json.loads((tmp_path / "benchmarks" / "quick" / "mapping.json").read_text())
    assert entry["command"] == "python -m benchmarks mapping --quick"
    assert set(entry) == ENTRY_KEYS and entry["versions"]["numpy"] == np.__version__
    assert (entry["value"], entry["peer_value"], entry["ratio"], entry["met"]) == (3.0, 2.0, 1.5, False)
    assert "missed: a tree" in capsys.readouterr().out
    entry = document([Entry("time", 0.123456789, "s")], ["python"])[0]  # four digits
    assert (entry["value"], entry["peer_value"], entry["ratio"], entry["met"]) == (0.1235, None, None, None)
    with pytest.raises(SystemExit) as stopped:
        main(["maping"])
    assert stopped.value.code == 2 and "did you mean mapping?" in capsys.readouterr().err
    for name in NAMES:
        module = import_module(f"benchmarks.{name}")
        assert callable(module.measure) and "Target" in module.__doc__


def test_a_row_of_trees_in_integers_has_what_was_proved_played_and_run(monkeypatch):
    monkeypatch.setattr(microcontrollers.Target, "missing", lambda target: None)
    right = microcontrollers.answers_hash

    def ran(target, fixed, n, folder, in_floats=None):
        return (
            microcontrollers.Ran(right(fixed, n), 5, 6, 70) if in_floats is None else microcontrollers.Ran(0, 8, 9, 90)
        )

    monkeypatch.setattr(fixed_point, "run_on", ran)
    monkeypatch.setattr(fixed_point, "EMLEARN", "")
    best = fixed_point.Best("mountaincar", RESULTS / "runs/mountaincar/otr/depth-1/standard-ars/seed-0", "pruned", 2)
    row = fixed_point._row(best, 1, 20)
    lines = fixed_point.table([row]).splitlines()
    heads, cells = (line.strip("| ").split(" | ") for line in (lines[-3], lines[-1]))
    shown = dict(zip(heads, cells, strict=True))
    assert 5e-6 < row.share < 5e-5 and shown["proved error"].startswith(f"{row.share:.3%} beyond ")
    assert abs(row.integers - row.floats) < 0.1 and row.floats > 90
    assert shown["leaves"] == "2" and shown["box"] == "declared" and shown["return, integers"] == f"{row.integers:.1f}"
    assert shown["AVR: bytes"] == "70 (90)" and shown["Cortex-M0: instructions"] == "5 (8)"
    assert "emlearn was not run" in fixed_point.table([row]) and "network (mountaincar)" in fixed_point.table([row])
    monkeypatch.setattr(fixed_point, "answers_hash", lambda fixed, n: right(fixed, n) + 1)
    with pytest.raises(RuntimeError, match="not those of Python"):
        fixed_point._row(best, 1, 20)


def test_functions_take_turns_and_the_least_round_counts():
    calls, ticks, lost = [], count(), [0.0]
    extra = iter([10.0, 0.0])  # seconds that "slow" takes beside the one of every reading of this clock

    def slow():
        calls.append("slow")
        lost[0] += next(extra)

    def clock():
        return next(ticks) + lost[0]

    assert alternate(slow, lambda: calls.append("fast"), rounds=2, clock=clock) == [1.0, 1.0]
    assert calls == ["slow", "fast", "slow", "fast"]
    two = iter([0.0, 6.0])
    assert alternate(lambda: None, rounds=1, repeats=3, clock=lambda: next(two)) == [2.0]  # timed together

    def hold_a_megabyte_twice():
        first = np.ones(2**17)  # named, so that numpy does not add in place
        return first + 1.0

    peak = peak_bytes(hold_a_megabyte_twice)  # counts what was let go again
    assert 2 * 2**20 <= peak < 2.1 * 2**20


def test_the_naive_peer_and_the_standing_policy_compute_what_they_say():
    generator = np.random.default_rng(0)
    for widths in ((3, 5, 2), (3, 2, 3, 2)):
        network = random_network(widths, generator)
        tree = copying_tree(list(network.weights), list(network.biases))
        for x in generator.normal(size=(20, 3)):
            node = tree
            while len(node) == 3:
                (P, v), left, right = node
                node = left if P @ x + v <= 0 else right
            np.testing.assert_allclose(node[0] @ x + node[1], network.forward(x), atol=1e-12)
    x = np.linspace(-1.0, 1.0, 11)
    expected = np.tanh(np.array(STANDING_GAINS) @ x + np.array(STANDING_OFFSETS))
    network = standing_policy()
    assert network.hidden_widths == (6,)
    for policy in (network, otr.map_network(network)):
        np.testing.assert_allclose(policy.predict(x), expected, atol=1e-12)


def test_the_search_s_share_is_of_the_steps_that_the_twin_did():
    """The twin costs nothing but its time: the search finds what it finds without it."""
    config = search.search_config("hopper")
    state = PolicySearch(config, 0).state()
    entry = search.share_of_environments(config, state, n_rounds=1)
    assert 0.3 < entry.ratio < 1.1 and entry.target == "ratio >= 0.85"
    twins = search.TwinEnv(config.env)
    plain = search.make_vector_env(config.env, "gymnasium")
    np.testing.assert_array_equal(twins.reset([1, 2]), plain.reset([1, 2]))
    before = twins.twin_seconds
    for actions in np.random.default_rng(0).uniform(-1, 1, (6, 2, 3)):
        for part, expected in zip(twins.step(actions), plain.step(actions), strict=True):
            np.testing.assert_array_equal(part, expected)
    assert twins.twin_seconds > before > 0.0


def test_turns_are_of_equal_steps_and_peers_of_equal_size(tmp_path):
    entry = search.against_peer(300, n_turns=1)
    assert entry.value > 0 and entry.peer == "sb3-contrib's ARS" and entry.target == "ratio >= 2"
    config = search.search_config("hopper", "depth=0", "method=linear")
    for turn in (search.search_turn(config, 300), search.peer_turn(config, 300)):
        assert 300 <= turn() < 3_000  # up to an iteration more, 16 short episodes
    config = training.run_config("hopper", 60, 30, 20)
    for model, train_segment in (training.our_trainer(config, tmp_path), training.plain_trainer(config)):
        train_segment()
        train_segment()
        assert model.num_timesteps == 60
    for n_parameters in (2_871, 16_100):
        for n_hidden_layers in (1, 2):
            network = control.relu_network(27, 8, n_hidden_layers, n_parameters)
            assert control.n_parameters_of(network) == pytest.approx(n_parameters, rel=0.01)
    seconds = supervised.Seconds(ours=4.0, dense=3.0, sparse=1.0, peer=80.0, loader=100.0)
    entries = supervised.entries_of("all", 8, seconds, judged=True)
    assert [entry.ratio for entry in entries] == [None, 0.75, 0.25, 0.05, 0.04]
    assert [entry.met for entry in entries] == [True, True, None, True, None]


def test_the_picture_has_the_curves_of_the_committed_runs(tmp_path, capsys):
    assert search_curves.write_picture(tmp_path, {}, tmp_path) == []
    assert "no picture" in capsys.readouterr().out
    curve = search_curves.curve(RESULTS / "runs/hopper/otr/depth-6/quick/seed-0", rate=100.0)
    assert curve["steps"].tolist() == list(range(5_000, 100_001, 5_000))
    assert curve["seconds"].tolist() == [0.0, *range(0, 901, 50)]  # the first 10,000 steps are random ones
    assert curve["best"].is_monotonic_increasing and curve["best"].iloc[-1] == pytest.approx(557, abs=1)
    rates = {"ars": 5_000.0, "sb3": 100.0, "fleet": 200.0}
    paths = search_curves.write_picture(RESULTS, rates, tmp_path / "benchmarks")
    assert [path.name for path in paths] == ["search.png", "search.svg"]
    assert all(path.stat().st_size > 10_000 for path in paths)


def test_of_each_trainer_the_longest_runs_are_shown():
    columns = ["env", "method", "depth", "form", "algorithm", "trainer", "budget", "settings", "steps"]
    tree = ("hopper", "otr", "6", "tree")
    longest = ("ars", "ars", "standard-ars", "", 4_000)
    rows = [
        (*tree, "sac", "fleet", "quick-fleet", "", 100), (*tree, "ars", "ars", "quick-ars", "", 300),
        (*tree, *longest), (*tree, *longest), (*tree, "ars", "ars", "standard-ars", "a1b2", 4_000),
        ("hopper", "otr", "6", "polished", *longest), ("hopper", "linear", "0", "tree", *longest[:4], 9_000),
    ]  # fmt: skip
    assert search_curves.shown_runs(pd.DataFrame(rows, columns=columns)).index.tolist() == [2, 3, 0]


def test_without_molecules_the_examples_train_and_it_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("OTR_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    problems, of_the_thesis = supervised.load_problems(quick=False)
    assert not of_the_thesis
    assert [problem.n_networks for problem in problems] == [10, 100]
    assert "no molecules" in capsys.readouterr().out
    for problem in problems:
        np.testing.assert_allclose(problem.X.mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_array_equal(problems[1].Y.sum(axis=1), 1.0)


@pytest.mark.skipif(not control.ORACLE.is_dir(), reason="the runs of the lander are not there")
def test_runs_of_dagger_are_timed():
    entries = {entry.name.split(":")[0]: entry for entry in control._dagger_runs(quick=True) if entry.target}
    assert list(entries) == ["AugTree, lander, depth 3", "VIPER, lander, depth 3"]
    assert all(0.0 < entry.value < 180.0 for entry in entries.values())


def test_a_polish_is_worth_its_paired_differences():
    before = np.array([1.0, 3.0, 5.0, 7.0])
    runs = [
        polish.PolishedRun(f"pendulum/otr/depth-6/quick/seed-{seed}", before, before + gains)
        for seed, gains in enumerate(([3.0, 5.0, 3.0, 5.0], [0.0, 0.0, 0.0, 0.0]))
    ]
    error = math.sqrt(1 / 3)  # of 3, 5, 3, 5: the deviation is sqrt(4 / 3), over sqrt(4)
    assert (runs[0].gain, runs[1].gain, runs[1].gain_error) == (4.0, 0.0, 0.0)
    assert runs[0].gain_error == pytest.approx(error)
    mean, gain = polish.group_entries(runs[0].group, runs)
    assert mean.name == "pendulum/otr/depth-6/quick, mean of 2 seeds"
    assert (mean.value, mean.peer_value, mean.target, mean.met) == (6.0, 4.0, "value >= -148", True)
    assert gain.value == 2.0 and gain.peer_value == pytest.approx(error / 2)
    other = polish.PolishedRun("pendulum/otr/depth-6/quick/seed-1~0123abcd", before, before)
    assert other.group == "pendulum/otr/depth-6/quick~0123abcd"
    mean, gain = polish.group_entries(other.group, [other])
    assert mean.target is None and (gain.value, gain.peer_value) == (0.0, None)
    name = "halfcheetah/distilled_otr/depth-6/standard-fleet/seed-0"  # its actor is not of a stage train
    run = polish.played_run(RESULTS / "runs" / name, name, 1)
    assert run.before.shape == run.after.shape == (1,) and run.before[0] > 1_000


def test_polished_runs_are_found_and_played_on_other_episodes(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("OTR_RESULTS_DIR", str(tmp_path))
    assert polish.measure(quick=True) == []
    assert f"no run under {tmp_path / 'runs'} has the stage polish" in capsys.readouterr().out
    words = ("env=mountaincar", "program=mountaincar", "budget=smoke", "n_workers=1", "polish=true")
    assert otr_command("otr-run", *words, cwd=tmp_path).returncode == 0
    (run_dir,) = tmp_path.glob("runs/mountaincar/program/depth-1/smoke/seed-0~*")
    tree = otr.load(run_dir / "polish/tree")
    otr.save(tree.replace(c=0.9 * tree.c), run_dir / "polish/tree")  # an iteration changes nothing
    after, gain, mean, _ = polish.measure(quick=True)
    env = EnvConfig("mountaincar", "mountaincar", "MountainCarContinuous-v0")
    seeds = range(polish.FIRST_SEED, polish.FIRST_SEED + 20)
    trees = [otr.load(run_dir / stage / "tree") for stage in ("prune", "polish")]
    returns = [play_seeds(tree.predict, env, seeds, n_workers=1).returns for tree in trees]
    assert after.name == f"mountaincar/program/depth-1/smoke/{run_dir.name}"
    assert after.peer_value == pytest.approx(returns[0].mean()) and after.value == pytest.approx(returns[1].mean())
    assert after.value != after.peer_value
    assert gain.value == pytest.approx((returns[1] - returns[0]).mean()) and mean.value == after.value
    # The reported episodes are no others than those that are played here: refused.
    text = (run_dir / "config.yaml").read_text()
    (run_dir / "config.yaml").write_text(text.replace("first_seed: 1000", f"first_seed: {polish.FIRST_SEED + 19}"))
    with pytest.raises(ValueError, match="reports the seeds 524307 to 524308"):
        polish.measure(quick=True)


def test_exact_measures_small_sizes_when_quick():
    pytest.importorskip("affinitree", reason="it has no wheel for this version of Python")
    from benchmarks import exact

    network = exact.network_of(3, 8, 1)
    assert exact.affinitree_seconds(network)[1] == otr.minimal_tree(network).n_leaves == 93
    entries = {entry.name: entry for entry in exact.measure(quick=True)}
    assert entries["8 neurons, 17 inputs: leaves"].value == 256
    assert all(entry.met for name, entry in entries.items() if name.endswith("leaves"))


@pytest.mark.skipif(not (shutil.which("gcc") and shutil.which("size")), reason="gcc or size is not installed")
@pytest.mark.parametrize("dtype", ["double", "float"])
def test_a_compiled_policy_answers_every_state_that_is_timed(dtype, tmp_path):
    generator = np.random.default_rng(0)
    network = random_network((4, 3, 2), generator, otr.TanhBox(-1.0, 1.0))
    states = generator.normal(size=(100, 4))
    for policy in (network, otr.map_network(network)):
        ns, answers = latency.run_compiled(policy, dtype, states, "gcc", tmp_path, rounds=1)
        np.testing.assert_allclose(answers, network.predict(states), atol=1e-5)
        assert 0.0 < ns < float("inf")
    # 3 neurons of 4 weights, a bias and 2 contributions, and 2 biases; what comes on top is code.
    n_bytes = latency.size_bytes(otr.to_c(network, dtype=dtype), "-Os", "gcc", tmp_path)
    tables = (3 * 7 + 2) * {"double": 8, "float": 4}[dtype]
    assert tables + 50 < n_bytes < tables + 1000


def test_the_mean_of_runs_is_where_all_of_them_are():
    rows = [
        *(("search", 0, 10 * k, k / 2, 100.0 * k) for k in (1, 3, 5)), ("search", 1, 20, 1.0, 500.0),
        ("search", 1, 40, 2.0, 700.0), ("SAC", 0, 10, 0.0, 50.0), ("SAC", 0, 20, 9.0, 60.0),
    ]  # fmt: skip
    curves = pd.DataFrame(rows, columns=["label", "seed", "steps", "seconds", "best"])
    steps, seconds = search_curves.return_against_cost(curves, "title").axes
    first, second, mean, sac = steps.lines
    assert [list(line.get_xdata()) for line in (first, second, sac)] == [[10, 30, 50], [20, 40], [10, 20]]
    assert list(zip(*mean.get_data(), strict=True)) == [(20, 300), (30, 400), (40, 500)]
    assert mean.get_linewidth() > first.get_linewidth() == second.get_linewidth()
    assert list(seconds.lines[2].get_xdata()) == [1.0, 1.5, 2.0]
    assert list(zip(*seconds.lines[3].get_data(), strict=True)) == [(9.0, 60.0)]  # 0 seconds have no place there
    assert steps.get_xscale() == seconds.get_xscale() == "log"


def test_trees_from_tables_are_compared_with_what_is_installed(monkeypatch, capsys):
    few = {name: tables.LEARNERS[name] for name in ("CART", "TAO")}
    monkeypatch.setattr(tables, "LEARNERS", few | {"gone": ("no_such_package", None)})
    entries = tables.measure(quick=True)
    assert [entry.name for entry in entries] == ["wine: CART", "wine: TAO", "diabetes: CART"]
    assert "gone is not installed" in capsys.readouterr().out
    assert all(entry.details["features_per_test"] == 1 for entry in entries if "CART" in entry.name)
    assert entries[1].value > entries[1].peer_value > 0.8


def test_the_page_has_the_committed_table():
    made = tables.markdown(json.loads((RESULTS / "benchmarks" / "tables.json").read_text()))
    assert f"<!-- table -->\n{made}\n<!-- end -->" in tables.PAGE.read_text()


def test_the_pendulums_values_are_those_of_its_plant():
    """One step costs what the state does; a torque that is always the same plays as gymnasium does."""
    costs, starts = pendulum_optimum.value_iteration(48, 33, n_steps=40), pendulum_optimum.evaluation_starts(20)
    angles, rates = np.meshgrid(np.arange(48) * np.pi / 24 - np.pi, np.linspace(-8, 8, 33), indexing="ij")
    np.testing.assert_allclose(costs[1], angles**2 + 0.1 * rates**2, rtol=1e-5)
    np.testing.assert_allclose(pendulum_optimum.interpolated(costs[1], angles + 4 * np.pi, rates), costs[1], atol=1e-4)
    assert (np.diff(costs, axis=0) >= -1e-4).all()  # of more steps, more
    best = pendulum_optimum.greedy_returns(costs, starts)
    assert -pendulum_optimum.interpolated(costs[-1], *starts.T).mean() == pytest.approx(best.mean(), rel=0.03)
    env = gymnasium.make("Pendulum-v1")
    for seed, expected in zip(range(1000, 1003), pendulum_optimum.greedy_returns(costs, starts[:3], 1), strict=True):
        env.reset(seed=seed)
        played = sum(float(env.step(np.array([-2.0], np.float32))[1]) for _ in range(40))
        assert played == pytest.approx(expected, rel=1e-6) and expected <= best[seed - 1000] + 1
