"""Figures 4.6 and 4.7 from runs: which count, what is drawn, what is written."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

import otr
from pipelines.config import AugTreeConfig, BudgetConfig, MethodConfig
from pipelines.engine.store import read_csv
from pipelines.errors import ConfigError, PipelineError
from pipelines.play.rollout import rollout
from pipelines.report.figure_4_6 import COLUMNS, depth_cells, write_figure_4_6
from pipelines.report.figure_4_7 import write_figure_4_7
from pipelines.report.figure_runs import budget_of_runs, check_figure
from pipelines.report.figures import DepthPoint, return_against_depth
from tests.pipelines.conftest import LANDER, PPO, otr_command

AUGTREE = AugTreeConfig("augtree", "all", "constant", 4, False, "entropy", 100, 1)
QUICK = BudgetConfig("quick", {"lunarlander": 300}, 100, 2, 2, 3, 100)


@pytest.fixture
def lander(tiny):
    """Return a function that makes a run of the lander that imitates an oracle."""

    def make(oracle, method, depth, seed):
        own = AUGTREE if method == "augtree" else MethodConfig(method)
        name = "-".join(map(str, oracle))
        return tiny(
            env=LANDER, algo=PPO, method=own, budget=QUICK, depth=depth, seed=seed, oracle=oracle,
            folder=f"runs/lunarlander/{method}/depth-{depth}/quick/seed-{seed}~{name}",
        )  # fmt: skip

    return make


def finish(run, results_dir, return_mean, oracle_mean=250.0, **changes):
    """Write the summary of a run."""
    summary = {
        "schema": "otr/summary/1", "method": run.method.name, "depth": run.depth, "seed": run.seed,
        "return_mean": return_mean, "n_episodes": 100, "oracle": {"hidden_widths": run.oracle},
        "policies": {"oracle": {"return_mean": oracle_mean}},
    }  # fmt: skip
    path = results_dir / run.folder / "summary.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(summary | changes))
    return path


def test_csv_has_every_cell_with_what_was_not_run(lander, tmp_path):
    runs = [lander([32], method, 2, seed) for method in ("augtree", "ndps") for seed in range(3)]
    for run, value in zip(runs, (100.0, 130.0, 160.0), strict=False):
        finish(run, tmp_path, value, oracle_mean=240.0 + 10 * run.seed)
    runs += [lander([64, 64], "viper", 3, seed) for seed in range(2)]
    finish(runs[-1], tmp_path, 50.0)
    paths = write_figure_4_6(runs, tmp_path)
    assert [path.name for path in paths] == ["figure_4_6.csv", "figure_4_6.png", "figure_4_6.svg"]
    rows = read_csv(paths[0])
    assert tuple(rows[0]) == COLUMNS
    assert [list(row.values()) for row in rows] == [
        ["[32]", "augtree", "2", "130.0", "30.0", "100.0", "160.0", "3", "100", "quick", "250.0", ""],
        ["[32]", "ndps", "2", "", "", "", "", "0", "", "quick", "250.0", "not run"],
        ["[64,64]", "viper", "3", "50.0", "", "", "", "1", "100", "quick", "250.0", "1 of 2 runs"],
    ]


def test_an_oracle_counts_once_for_all_that_imitate_it(lander, tmp_path):
    runs = [lander([32], "augtree", depth, 0) for depth in (2, 3, 4)] + [lander([32], "augtree", 2, 1)]
    for run in runs:
        finish(run, tmp_path, 1.0, oracle_mean=100.0 if run.seed == 0 else 200.0)
    assert {cell.oracle_mean for cell in depth_cells(runs, tmp_path)} == {150.0}


def test_without_runs_there_is_the_csv_alone(lander, tmp_path):
    (path,) = write_figure_4_6([lander([32], "viper", 2, 0)], tmp_path)
    assert read_csv(path)[0]["note"] == "not run"


def test_same_runs_give_the_same_bytes(lander, tmp_path):
    run = lander([32], "viper", 2, 0)
    finish(run, tmp_path, 1.0)
    first = [path.read_bytes() for path in write_figure_4_6([run], tmp_path)]
    assert first == [path.read_bytes() for path in write_figure_4_6([run], tmp_path)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 7}, "expected"),
        ({"policies": {}}, "it has no 'oracle'"),
        ({"oracle": {"hidden_widths": [8]}}, "expected"),
    ],
)
def test_a_summary_of_another_run_is_named(lander, tmp_path, changes, message):
    run = lander([32], "viper", 2, 0)
    path = finish(run, tmp_path, 1.0, **changes)
    with pytest.raises(PipelineError, match=f"(?s){path.parent.name}.*{message}"):
        write_figure_4_6([run], tmp_path)


def test_curves_bands_and_lines_are_where_the_points_say():
    points = [
        DepthPoint("[32]", "AugTree", 3, 230.0, 10.0, 260.0),
        DepthPoint("[32]", "AugTree", 2, 200.0, 20.0, 260.0),
        DepthPoint("[32]", "VIPER", 2, -37.0, None, 260.0),
        DepthPoint("[256]", "AugTree", 2, 210.0, 5.0),
    ]
    left, right = return_against_depth(points, 200.0, "title").axes
    assert [panel.get_title(loc="left") for panel in (left, right)] == ["oracle [32]", "oracle [256]"]
    lines = [(list(line.get_xdata()), list(line.get_ydata())) for line in left.lines]
    assert lines == [([0, 1], [200.0] * 2), ([0, 1], [260.0] * 2), ([2, 3], [200.0, 230.0]), ([2], [-37.0])]
    (band,) = left.collections
    np.testing.assert_allclose(band.get_datalim(left.transData).get_points(), [[2, 180], [3, 240]])
    assert len(right.lines) == 2 and left.get_xticks().tolist() == [2, 3]
    with pytest.raises(ValueError, match="no points"):
        return_against_depth([], 200.0)


@pytest.fixture
def depth_two(lander, tmp_path):
    """Two finished runs of an oracle [256] and one of [32], with a tree that turns the lander upright."""
    P = np.zeros((3, 8))
    P[0, [4, 5, 0]], P[1, [3, 1]], P[2, [3, 1]] = [1, 0.5, 0.001], [1, 0.3], [1, 0.3]
    tree = otr.ObliqueTree(
        [1, ~0, ~2], [2, ~1, ~3], P, [0.0, 0.1, 0.1], np.zeros((4, 4, 8)), np.eye(4), labels=[2, 1, 2, 3],
        head=otr.Argmax(),
    )  # fmt: skip
    runs = [lander([256], "augtree", 2, 0), lander([256], "augtree", 2, 1), lander([32], "augtree", 2, 0)]
    for run, selection_mean, reported in zip(runs, (10.0, 20.0, 900.0), (500.0, 1.0, 2.0), strict=True):
        folder = finish(run, tmp_path, reported).parent / "imitate"
        folder.mkdir()
        otr.save(tree, folder / "tree")
        rows = f"round,selection_mean,chosen\n0,999.0,False\n1,{selection_mean},True\n"
        (folder / "iterates.csv").write_text(rows)
    return runs, tree


def test_figure_4_7_is_the_run_of_the_best_selection_return(depth_two, tmp_path):
    runs, tree = depth_two
    text, picture = write_figure_4_7(runs, tmp_path)
    printed = text.read_text()
    assert runs[1].folder in printed and picture.name == "figure_4_7.png"
    played = rollout(tree.predict, LANDER, [1000, 1001, 1002], n_workers=1).returns
    assert f"Before: return {played.mean():.1f} ± {played.std():.1f} over 3 episodes (thesis: 249.1)" in printed
    assert "(thesis: 246.8)" in printed and "after" in printed
    before = [path.read_bytes() for path in (text, picture)]
    assert before == [path.read_bytes() for path in write_figure_4_7(runs, tmp_path)]


def test_figure_4_7_takes_other_oracles_where_it_must(depth_two, tmp_path):
    runs, _ = depth_two
    for run in runs[:2]:
        shutil.rmtree(tmp_path / run.folder)
    assert runs[2].folder in write_figure_4_7(runs, tmp_path)[0].read_text()
    shutil.rmtree(tmp_path / runs[2].folder)
    with pytest.raises(PipelineError, match=r"otr-run \+experiment=figure_4_6"):
        write_figure_4_7(runs, tmp_path)


def test_budget_is_the_first_that_was_run(lander, tmp_path):
    assert budget_of_runs(tmp_path) == "quick"
    run = lander([32], "viper", 2, 0)
    finish(dataclasses.replace(run, folder=run.folder.replace("quick", "thesis")), tmp_path, 1.0)
    assert budget_of_runs(tmp_path) == "thesis"
    with pytest.raises(ConfigError, match=r"figure=4\.5 is not known.*Known figures: 4\.6, 4\.7"):
        check_figure("4.5")


def test_the_command_reads_the_runs_of_the_experiment(tmp_path):
    (tmp_path / "results/runs").mkdir(parents=True)
    done = otr_command("otr-tabulate", "figure=4.6", "budget=smoke", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = read_csv(tmp_path / "results/figures/figure_4_6.csv")
    assert [(row["oracle"], row["method"], row["depth"], row["note"]) for row in rows] == [
        ("[32]", method, "2", "not run") for method in ("augtree", "viper", "ndps")
    ]
    assert not (tmp_path / "results/tables").exists()
    done = otr_command("otr-tabulate", "figure=4.8", cwd=tmp_path)
    assert done.returncode == 2 and "Known figures: 4.6, 4.7" in done.stderr
