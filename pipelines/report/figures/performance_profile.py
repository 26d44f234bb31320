"""The performance profile: the share of a method's runs above a normalised score, over the tasks that it was run on.

Lines are of the columns of Table 4.1 that have runs of at least three tasks. Their runs are those of the cells that the
table's page shows: the table's own, and those of its methods and depths on the tasks beyond it.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import otr
from pipelines.engine.command_text import command_text
from pipelines.errors import MissingInputError
from pipelines.report.cells import DECIMALS, KEY, METHOD_NAMES, SOURCE, TASK_NAMES, table_runs
from pipelines.report.figures.style import COLOURS, DASHES, SMALL, figure_of_panels, legend_line, set_legend
from pipelines.report.published import best_published
from pipelines.report.statistics import performance_profile
from pipelines.report.table_4_1 import COLUMNS as COLUMNS_OF_TABLE
from pipelines.report.table_4_1 import make_cells
from pipelines.report.text import csv_text, write_file
from pipelines.runs.below_random import random_returns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POLICIES = pd.DataFrame(COLUMNS_OF_TABLE, columns=KEY[1:])
MIN_TASKS = 3
COLUMNS = ["method", "depth", "n_runs", "n_tasks", "tasks", "threshold", "share"]


def write_performance_profile(results_dir: Path, runs: pd.DataFrame) -> list[Path]:
    """Write `performance_profile.csv`, a row for each step of each line, and the picture under `results_dir/figures`.

    Args:
        results_dir: the folder that holds `runs`.
        runs: as `load_runs` returns them.

    Raises:
        MissingInputError: no method has runs of enough tasks; names the command.
    """
    lines = profiles(scored_runs(runs))
    if lines.empty:
        raise MissingInputError(
            f"{results_dir}: no method of Table 4.1 has been run on {MIN_TASKS} tasks.\n"
            f"Run: {command_text('otr-run', ['+experiment=table_4_1'], results_dir)}"
        )
    path = write_file(results_dir / "figures" / "performance_profile.csv", csv_text(lines.round(DECIMALS)))
    otr.save_picture(draw_profiles(lines), path.with_suffix(".png"))
    return [path, path.with_suffix(".png")]


def scored_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs that the lines are made of, with their `score`.

    It is 0 for the return of random actions and 1 for the best return that the thesis gives for the task, by whatever
    method, and linear between and beyond: a ratio of returns would be turned around where they are negative.
    """
    own = table_runs(runs)
    cells = make_cells(own)
    own = own.merge(cells.loc[cells["table"] != "other", [*KEY, *SOURCE]]).merge(POLICIES)
    worst, best = own["task"].map(random_returns()), own["task"].map(best_published)
    scores = (own["return_mean"].astype(float) - worst) / (best - worst)
    own = own.assign(score=scores.round(DECIMALS))
    return own[own["score"].notna()]


def profiles(scored: pd.DataFrame) -> pd.DataFrame:
    """Return the steps of the lines, a row a method and threshold: the ends of the axis and the scores between them."""
    if scored.empty:
        return pd.DataFrame(columns=COLUMNS)
    ends = [(math.ceil(10 * scored["score"].min()) - 1) / 10, math.ceil(10 * scored["score"].max()) / 10]
    lines = []
    for method, depth in COLUMNS_OF_TABLE:
        own = scored[(scored["method"] == method) & (scored["depth"] == depth)]
        tasks = [task for task in TASK_NAMES if task in set(own["task"])]
        if len(tasks) < MIN_TASKS:
            continue
        thresholds = np.unique([*ends, *own["score"]])
        shares = performance_profile([own.loc[own["task"] == task, "score"] for task in tasks], thresholds)
        line = pd.DataFrame({"threshold": thresholds, "share": shares})
        lines.append(
            line.assign(method=method, depth=depth, n_runs=len(own), n_tasks=len(tasks), tasks=" ".join(tasks))
        )
    return pd.concat(lines)[COLUMNS] if lines else pd.DataFrame(columns=COLUMNS)


def draw_profiles(lines: pd.DataFrame) -> Figure:
    """Return a figure of the lines, as `profiles` returns them, in their order; the legend says of how many runs."""
    axes = ("score: 0 for random actions, 1 for the best published", "share of runs above it")
    policies = lines.groupby(["method", "depth"], sort=False)
    figure, (panel,) = figure_of_panels(
        pd.DataFrame({"panel": [""]}), 1, 1.7, axes, math.ceil(policies.ngroups / 2) + 1
    )
    handles = []
    # Every other line is dashed and lies above the solid ones, so that two that fall together are both seen.
    styles = zip(COLOURS, itertools.cycle(((DASHES, 3), ("-", 2))), strict=False)
    for ((method, depth), line), (colour, (dashes, zorder)) in zip(policies, styles, strict=False):
        style: dict[str, Any] = {"color": colour, "linestyle": dashes, "linewidth": 1.4, "zorder": zorder}
        panel.step(line["threshold"], line["share"], where="post", **style)
        n_runs, n_tasks = line["n_runs"].iloc[0], line["n_tasks"].iloc[0]
        text = f"{METHOD_NAMES[method]} ({depth}): {n_runs} runs, {n_tasks} of {len(TASK_NAMES)} tasks"
        handles.append(legend_line(text, **style))
    panel.margins(x=0, y=0.03)
    title = "Share of runs above a score, mean over the tasks that a method was run on\n"
    figure.suptitle(f"{title}(tasks that were not run are left out, so lines are over different tasks)", fontsize=SMALL)
    set_legend(figure, handles, 2)
    return figure
