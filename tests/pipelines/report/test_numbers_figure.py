"""The figure of returns against numbers: its points and fronts."""

from pathlib import Path

import pandas as pd
import pytest

from pipelines.errors import MissingInputError
from pipelines.report.cells import table_runs
from pipelines.report.figures.numbers import MEAN, draw_numbers, points_of, write_numbers
from pipelines.report.frames import load_runs
from pipelines.report.published import best_published
from pipelines.report.table_4_1 import TASKS
from pipelines.runs.below_random import random_returns
from tests.pipelines.report.conftest import write_run

POLICIES = {"linear": ("0", 10.0, 0.5), "otr": ("6", 1000.0, 0.75), "viper": ("6", 100.0, 0.25)}


@pytest.fixture
def points(tmp_path: Path) -> pd.DataFrame:
    """Three policies on every task, of sizes as given, and a fourth on one task."""
    for task in TASKS:
        for method, (depth, _, score) in POLICIES.items():
            reached = random_returns()[task] + score * (best_published(task) - random_returns()[task])
            write_run(tmp_path, f"{task}/{method}/depth-{depth}/quick/seed-0", reached)
    write_run(tmp_path, "hopper/ndps/depth-6/quick/seed-0", 3641.5)
    runs = table_runs(load_runs(tmp_path))
    sizes = runs["method"].map({method: size for method, (_, size, _) in POLICIES.items()}).fillna(500.0)
    return points_of(runs.assign(written_numbers=sizes, free_numbers=sizes, leaves=2.0, total_steps=1.0))


def test_a_front_leaves_out_what_a_smaller_policy_exceeds(points: pd.DataFrame) -> None:
    assert list(dict.fromkeys(points["task"])) == [*TASKS, MEAN]
    found = {task: set(own.loc[own["on_front"], "method"]) for task, own in points.groupby("task")}
    assert found == {task: {"linear", "otr"} for task in (*TASKS, MEAN)} | {"hopper": {"linear", "ndps"}}
    mean = points[points["task"] == MEAN].set_index("method")
    assert mean["score"].round(9).to_dict() == {method: score for method, (_, _, score) in POLICIES.items()}
    assert mean["written_numbers"].round(6).to_dict() == {method: size for method, (_, size, _) in POLICIES.items()}


def test_points_of_others_are_drawn_and_no_part_of_the_front(points: pd.DataFrame) -> None:
    figure = draw_numbers(points)
    walker = figure.axes[TASKS.index("walker2d")]
    assert walker.get_xscale() == "log" and len(figure.axes) == 9
    stars = {float(line.get_xdata()[0]) for line in walker.lines if line.get_marker() == "*"}
    assert stars == {23.0, 108.0} and [text.get_text() for text in walker.texts] == ["ARS, 1.97", "EMI NEAT"]
    (front,) = (line for line in walker.lines if line.get_drawstyle() == "steps-post")
    assert list(front.get_ydata()) == pytest.approx([0.5, 0.75, 0.75])
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["Linear", "VIPER", "NDPS", "OTR", "front of ours", "published elsewhere"]


def test_without_runs_the_command_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"otr-run \+experiment=table_4_1"):
        write_numbers(tmp_path, load_runs(tmp_path))
