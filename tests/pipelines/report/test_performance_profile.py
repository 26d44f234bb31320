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
from pipelines.report.figures.performance_profile import draw_profiles, random_returns, write_performance_profile
from pipelines.report.frames import load_runs
from pipelines.report.published import best_published
from tests.pipelines.report.conftest import write_run


def test_random_actions_are_worse_than_what_is_published_in_every_task() -> None:
    assert tuple(random_returns()) == tuple(TASK_NAMES)
    assert all(random_returns()[task] < best_published(task) for task in TASK_NAMES)
    assert (best_published("pendulum"), best_published("lunarlander")) == (-135.0, 269.0)
    text = (resources.files("pipelines") / "random_returns.csv").read_text(encoding="utf-8")
    for row in csv.DictReader(text.splitlines()):
        assert row["env_id"] == run_config([f"env={row['task']}"]).env.id


def test_the_legend_says_how_many_runs_and_tasks(tmp_path: Path) -> None:
    tasks = ("pendulum", "swimmer", "mountaincar")
    for i, task in enumerate(tasks):
        if i == 2:
            with pytest.raises(MissingInputError, match=r"on 3 tasks\.\nRun: otr-run \+experiment=table_4_1"):
                write_performance_profile(tmp_path, load_runs(tmp_path))
        least = random_returns()[task]
        for seed, score in enumerate((0.5, 0.75)):
            reached = least + score * (best_published(task) - least)
            write_run(tmp_path, f"{task}/viper/depth-6/quick/seed-{seed}", reached)
    table, picture = write_performance_profile(tmp_path, load_runs(tmp_path))
    assert picture.name == "performance_profile.png" and picture.is_file()
    lines = pd.DataFrame(read_csv(table)).astype({"n_runs": int, "n_tasks": int, "threshold": float, "share": float})
    figure = draw_profiles(lines)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["VIPER (6): 6 runs, 3 of 10 tasks"]
    (line,) = figure.axes[0].lines
    assert line.get_drawstyle() == "steps-post" and list(line.get_ydata()) == [1.0, 0.5, 0.0, 0.0]
