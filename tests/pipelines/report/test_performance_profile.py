"""The performance profile: which runs are in it, what their scores are, what is drawn."""

import csv
from importlib import resources
from pathlib import Path

import pandas as pd
import pytest

from pipelines.cli.runs import run_config
from pipelines.engine.store import read_csv
from pipelines.errors import MissingInputError
from pipelines.report.cells import TASK_NAMES
from pipelines.report.figures.performance_profile import (
    draw_profiles,
    random_returns,
    scored_runs,
    write_performance_profile,
)
from pipelines.report.frames import load_runs
from pipelines.report.published import best_published
from tests.pipelines.report.conftest import write_run

TASKS = ("pendulum", "swimmer", "mountaincar")


def return_of(task: str, score: float) -> float:
    return random_returns()[task] + score * (best_published(task) - random_returns()[task])


def write_runs(results_dir: Path, policy: str, scores: dict[str, list[float]]) -> None:
    for task, own in scores.items():
        for seed, score in enumerate(own):
            write_run(results_dir, f"{task}/{policy}/quick/seed-{seed}", return_of(task, score))


def test_random_actions_are_worse_than_what_is_published_in_every_task() -> None:
    assert tuple(random_returns()) == tuple(TASK_NAMES)
    assert all(random_returns()[task] < best_published(task) for task in TASK_NAMES)
    assert (best_published("pendulum"), best_published("lunarlander")) == (-135.0, 269.0)
    text = (resources.files("pipelines") / "random_returns.csv").read_text(encoding="utf-8")
    for row in csv.DictReader(text.splitlines()):
        assert row["env_id"] == run_config([f"env={row['task']}"]).env.id


def test_scores_are_of_the_runs_that_table_4_1_shows(tmp_path: Path) -> None:
    write_runs(tmp_path, "viper/depth-6", {"pendulum": [0.0, 0.5, 1.0]})
    write_runs(tmp_path, "viper/depth-4", {"pendulum": [0.25]})  # of no column
    write_run(tmp_path, "pendulum/viper/depth-6/quick-fleet/seed-0", -150.0)  # beside the table's cell
    write_run(tmp_path, "pendulum/viper/depth-6/smoke/seed-0", -1500.0)
    write_run(tmp_path, "cartpole/viper/depth-6/quick/seed-0", 500.0)  # nothing is published of it
    assert sorted(scored_runs(load_runs(tmp_path))["score"]) == pytest.approx([0.0, 0.5, 1.0])


def test_the_legend_says_how_many_runs_and_tasks(tmp_path: Path) -> None:
    write_runs(tmp_path, "viper/depth-6", {task: [0.5, 0.75] for task in TASKS[:2]})
    with pytest.raises(MissingInputError, match=r"on 3 tasks\.\nRun: otr-run \+experiment=table_4_1"):
        write_performance_profile(tmp_path, load_runs(tmp_path))
    write_runs(tmp_path, "viper/depth-6", {task: [0.5, 0.75] for task in TASKS[2:]})
    table, picture = write_performance_profile(tmp_path, load_runs(tmp_path))
    assert picture.name == "performance_profile.png" and picture.is_file()
    lines = pd.DataFrame(read_csv(table)).astype({"n_runs": int, "n_tasks": int, "threshold": float, "share": float})
    assert lines["threshold"].tolist() == pytest.approx([0.4, 0.5, 0.75, 0.8]) and set(lines["n_runs"]) == {6}
    figure = draw_profiles(lines)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["VIPER (6): 6 runs, 3 of 10 tasks"]
    (line,) = figure.axes[0].lines
    assert line.get_drawstyle() == "steps-post" and list(line.get_ydata()) == [1.0, 0.5, 0.0, 0.0]
