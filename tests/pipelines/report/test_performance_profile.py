"""The performance profile: which runs are in it, what their scores are, what is drawn."""

import csv
from importlib import resources
from pathlib import Path

import pandas as pd
import pytest

from pipelines.cli.runs import run_config
from pipelines.errors import MissingInputError
from pipelines.report.cells import TASK_NAMES
from pipelines.report.figures.performance_profile import draw_profiles, write_performance_profile
from pipelines.report.frames import load_runs
from pipelines.report.published import best_published
from pipelines.runs.below_random import random_returns
from tests.pipelines.report.conftest import write_run


def test_random_actions_are_worse_than_what_is_published_in_every_task() -> None:
    assert tuple(random_returns()) == tuple(TASK_NAMES)
    assert all(random_returns()[task] < best_published(task) for task in TASK_NAMES)
    assert (best_published("pendulum"), best_published("lunarlander")) == (-135.0, 269.0)
    text = (resources.files("pipelines") / "random_returns.csv").read_text(encoding="utf-8")
    for row in csv.DictReader(text.splitlines()):
        assert row["env_id"] == run_config([f"env={row['task']}"]).env.id


def test_methods_of_three_tasks_are_drawn_over_the_tables_tasks(tmp_path: Path) -> None:
    for i, task in enumerate(("pendulum", "mountaincar", "swimmer", "reacher")):
        if i == 3:
            with pytest.raises(MissingInputError, match=r"on 3 tasks\.\nRun: otr-run \+experiment=table_4_1"):
                write_performance_profile(tmp_path, load_runs(tmp_path))
        least = random_returns()[task]
        for seed, score in enumerate((0.5, 0.75)):
            reached = least + score * (best_published(task) - least)
            write_run(tmp_path, f"{task}/viper/depth-6/quick/seed-{seed}", reached)
    profile, means, picture = write_performance_profile(tmp_path, load_runs(tmp_path))
    assert picture.name == "performance_profile.png" and picture.is_file()
    (mean,) = pd.read_csv(means).to_dict("records")
    assert (mean["tasks"], mean["iqm"]) == ("reacher swimmer pendulum", 0.625)
    assert 0.5 <= mean["ci_low"] < 0.625 < mean["ci_high"] <= 0.75
    figure = draw_profiles(pd.read_csv(means), pd.read_csv(profile))
    left, right = figure.axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["VIPER (6), 6 runs, 3 tasks"]
    (line,) = right.lines
    assert line.get_drawstyle() == "steps-post" and list(line.get_ydata()) == [1.0, 0.5, 0.0, 0.0]
