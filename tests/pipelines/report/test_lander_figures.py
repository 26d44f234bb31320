"""Figures 4.6 and 4.7 from runs: which count, what is drawn, what is written."""

import shutil
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

import otr
from pipelines.config.budget import BudgetConfig
from pipelines.config.methods import AugTreeConfig
from pipelines.engine.store import read_csv
from pipelines.errors import MissingInputError, PipelineError
from pipelines.play.episodes import play_seeds
from pipelines.report.figures import figure_4_6, figure_4_7
from pipelines.report.figures.figure_4_6 import budget_of_runs
from pipelines.report.figures.style import return_against_depth
from pipelines.report.frames import load_runs
from tests.pipelines.conftest import LANDER, PPO, otr_command, otr_succeeds
from tests.pipelines.report.conftest import write_run

AUGTREE = AugTreeConfig("augtree", features="all", max_samples=100)
QUICK = BudgetConfig("quick", {"lunarlander": 300}, 100, 2, 2, 3, 100)


class Run(NamedTuple):
    oracle: str
    run: str


def run_of(oracle, method, depth, seed):
    name = oracle.strip("[]").replace(",", "-")
    return Run(oracle, f"lunarlander/{method}/depth-{depth}/quick/seed-{seed}~{name}")


def finish(run, results_dir, return_mean, oracle_mean=250.0, **changes):
    oracle = {"hidden_widths": [int(width) for width in run.oracle.strip("[]").split(",")]}
    policies = {"oracle": {"return_mean": oracle_mean, "n_episodes": 100}}
    return write_run(results_dir, run.run, return_mean, **({"oracle": oracle, "policies": policies} | changes))


def write_figure_4_6(results_dir):
    return figure_4_6.write_figure_4_6(load_runs(results_dir), "quick", results_dir)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 7}, "describes the run lunarlander/viper/depth-2/quick/seed-7"),
        ({"policies": {}}, "it has no 'policies.oracle'"),
    ],
)
def test_a_summary_of_another_run_is_named(tmp_path, changes, message):
    run = run_of("[32]", "viper", 2, 0)
    path = finish(run, tmp_path, 1.0, **changes)
    with pytest.raises(PipelineError, match=f"(?s){path.parent.name}.*{message}"):
        write_figure_4_6(tmp_path)


def test_curves_bands_and_lines_are_where_the_points_say():
    rows = [
        ("[32]", "AugTree", 3, 230.0, 10.0, 260.0),
        ("[32]", "AugTree", 2, 200.0, 20.0, 260.0),
        ("[32]", "VIPER", 2, -37.0, np.nan, 260.0),
        ("[256]", "AugTree", 2, 210.0, 5.0, np.nan),
    ]
    points = pd.DataFrame(rows, columns=["panel", "label", "depth", "mean", "std", "oracle_mean"])
    left, right = return_against_depth(points, 200.0, "title").axes
    assert [panel.get_title(loc="left") for panel in (left, right)] == ["[32]", "[256]"]
    lines = [(list(line.get_xdata()), list(line.get_ydata())) for line in left.lines]
    assert lines == [([0, 1], [200.0] * 2), ([0, 1], [260.0] * 2), ([2, 3], [200.0, 230.0]), ([2], [-37.0])]
    (band,) = left.collections
    np.testing.assert_allclose(band.get_datalim(left.transData).get_points(), [[2, 180], [3, 240]])
    (bar,) = right.collections  # where a band would have no width
    np.testing.assert_allclose(bar.get_segments(), [[[2, 205], [2, 215]]])
    assert len(right.lines) == 2 and left.get_xticks().tolist() == [2, 3]
    with pytest.raises(ValueError, match="no points"):
        return_against_depth(points[:0], 200.0)
    names = ("AugTree", "VIPER", "NDPS (affine leaves)", "Linear (no oracle)", "Linear (imitating)")
    wide = pd.concat([points.assign(label=name) for name in names])
    figure = return_against_depth(wide, 200.0)
    figure.canvas.draw()
    extent = figure.legends[0].get_window_extent()
    assert 0 <= extent.x0 < extent.x1 <= figure.bbox.width


@pytest.fixture
def depth_two(tiny, tmp_path):
    """Two finished runs of an oracle [256] and one of [32], with a tree that turns the lander upright."""
    P = np.zeros((3, 8))
    P[0, [4, 5, 0]], P[1, [3, 1]], P[2, [3, 1]] = [1, 0.5, 0.001], [1, 0.3], [1, 0.3]
    tree = otr.ObliqueTree(
        [1, ~0, ~2], [2, ~1, ~3], P, [0.0, 0.1, 0.1], np.zeros((4, 4, 8)), np.eye(4), labels=[2, 1, 2, 3],
        head=otr.Argmax(),
    )  # fmt: skip
    runs = [run_of(oracle, "augtree", 2, seed) for oracle, seed in (("[256]", 0), ("[256]", 1), ("[32]", 0))]
    for run, selection_mean, reported in zip(runs, (10.0, 20.0, 900.0), (500.0, 1.0, 2.0), strict=True):
        folder = finish(run, tmp_path, reported, return_std=0.5, n_episodes=3).parent / "imitate"
        folder.mkdir()
        otr.save(tree, folder / "tree")
        rows = f"round,selection_mean,chosen\n0,999.0,False\n1,{selection_mean},True\n"
        (folder / "iterates.csv").write_text(rows)
    config = tiny(env=LANDER, algo=PPO, method=AUGTREE, budget=QUICK, depth=2)

    def write():
        return figure_4_7.write_figure_4_7(load_runs(tmp_path), "quick", lambda run_dir: config, tmp_path)

    return runs, write


def test_figure_4_7_is_the_run_of_the_best_selection_return(depth_two, monkeypatch):
    played = []

    def recorded(policy, env, seeds, **options):
        played.append((list(seeds), play_seeds(policy, env, seeds, **options)))
        return played[-1][1]

    monkeypatch.setattr("pipelines.play.episodes.play_seeds", recorded)
    runs, write = depth_two
    text, picture = write()
    printed = text.read_text()
    assert f"runs/{runs[1].run}" in printed and picture.name == "figure_4_7.png"
    assert "Before: return 1.0 ± 0.5 over 3 episodes (thesis: 249.1)" in printed  # as the run recorded
    seeds, last = played[-1]  # the simpler tree on the evaluation's episodes, and those alone
    assert seeds == [1000, 1001, 1002] and all(1000 not in others for others, _ in played[:-1])
    assert f"After: return {last.returns.mean():.1f} ± {last.returns.std():.1f} over 3 episodes" in printed
    assert "(thesis: 246.8)" in printed
    before = [path.read_bytes() for path in (text, picture)]
    assert before == [path.read_bytes() for path in write()]


def test_figure_4_7_takes_other_oracles_where_it_must(depth_two, tmp_path):
    runs, write = depth_two
    for run in runs[:2]:
        shutil.rmtree(tmp_path / "runs" / run.run)
    assert runs[2].run in write()[0].read_text()
    shutil.rmtree(tmp_path / "runs" / runs[2].run)
    with pytest.raises(MissingInputError, match=r"otr-run \+experiment=figure_4_6"):
        write()


def test_trees_of_a_budget_and_their_oracles_are_in_the_order_of_the_panels(tmp_path):
    for oracle, method, depth, seed in (
        ("[256]", "viper", 2, 0), ("[32]", "viper", 10, 0), ("[32]", "viper", 2, 0), ("[32]", "viper", 2, 1),
        ("[32]", "augtree", 2, 1), ("[32]", "distilled_otr", 0, 0), ("[32]", "distilled_otr", 2, 0),
    ):  # fmt: skip
        finish(run_of(oracle, method, depth, seed), tmp_path, float(depth + seed), oracle_mean=float(seed))
    finish(run_of("[32]", "ndps", 2, 0), tmp_path, 9.0, changes="method.leaves=constant, oracle=[32]")
    table, *pictures = write_figure_4_6(tmp_path)
    rows = [(row["oracle"], row["method"], row["depth"], row["mean"], row["n_runs"]) for row in read_csv(table)]
    assert rows == [
        ("[32]", "distilled-otr", "0", "0.0", "1"), ("[32]", "augtree", "2", "3.0", "1"),
        ("[32]", "viper", "2", "2.5", "2"), ("[32]", "viper", "10", "10.0", "1"), ("[256]", "viper", "2", "2.0", "1"),
    ]  # fmt: skip
    assert [float(row["oracle_mean"]) for row in read_csv(table)] == [0.5, 0.5, 0.5, 0.5, 0.0]
    assert [path.name for path in pictures] == ["figure_4_6.png", "figure_4_6.svg"]


def test_the_command_takes_the_first_budget_that_was_run(tmp_path):
    results = tmp_path / "results"
    (results / "runs").mkdir(parents=True)
    otr_succeeds("otr-tabulate", "figure=4.6", "budget=smoke", cwd=tmp_path)
    assert read_csv(results / "figures/figure_4_6.csv") == []
    assert not (results / "tables").exists()
    done = otr_command("otr-tabulate", "figure=4.8", cwd=tmp_path)
    assert done.returncode == 2 and "Known figures: 4.6, 4.7" in done.stderr
    assert budget_of_runs(load_runs(results)) == "quick"  # else the first that was run
    run = run_of("[32]", "viper", 2, 0)
    finish(run._replace(run=run.run.replace("quick", "thesis")), results, 1.0)
    assert budget_of_runs(load_runs(results)) == "thesis"
