"""All tasks of Table 4.1 at once: interquartile means with intervals, and performance profiles with bands.

Both are of the table's columns, of the runs in its cells, under scores of one scale (Agarwal et al. 2021). Intervals
and bands are of the stratified bootstrap over runs.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import otr
from pipelines.engine.command_text import command_text
from pipelines.errors import MissingInputError
from pipelines.report.cells import DECIMALS, KEY, METHOD_NAMES, SOURCE, normalised, table_runs
from pipelines.report.figures.style import DASHES, OF_METHODS, figure_of_panels, legend_line, set_legend
from pipelines.report.statistics import performance_profile, profile_band, stratified_iqm
from pipelines.report.table_4_1 import COLUMNS as COLUMNS_OF_TABLE
from pipelines.report.table_4_1 import TASKS, make_cells
from pipelines.report.text import csv_text, write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POLICIES = pd.DataFrame(COLUMNS_OF_TABLE, columns=KEY[1:])
MIN_TASKS = 3
LARGE = ("otr", "32")
OF_POLICY = ["method", "depth", "n_runs", "n_tasks", "tasks"]
COLUMNS = [*OF_POLICY, "threshold", "share", "share_low", "share_high"]
COLUMNS_OF_MEANS = [*OF_POLICY, "iqm", "ci_low", "ci_high"]


def write_performance_profile(results_dir: Path, runs: pd.DataFrame) -> list[Path]:
    """Write `performance_profile.csv`, a row for each step of each line, `interquartile_means.csv` and the picture.

    Args:
        results_dir: the folder that holds `runs`.
        runs: as `load_runs` returns them.

    Raises:
        MissingInputError: no method has runs of enough tasks; names the command.
    """
    means, lines = of_policies(scored_runs(runs))
    if lines.empty:
        raise MissingInputError(
            f"{results_dir}: no method of Table 4.1 has been run on {MIN_TASKS} tasks.\n"
            f"Run: {command_text('otr-run', ['+experiment=table_4_1'], results_dir)}"
        )
    texts = {"performance_profile": lines, "interquartile_means": means}
    paths = [
        write_file(results_dir / "figures" / f"{name}.csv", csv_text(frame.round(DECIMALS)))
        for name, frame in texts.items()
    ]
    otr.save_picture(draw_profiles(means, lines), paths[0].with_suffix(".png"))
    return [*paths, paths[0].with_suffix(".png")]


def scored_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs that the figure is made of, with their `score`, as `normalised` has it."""
    own = table_runs(runs)
    cells = make_cells(own)
    own = own.merge(cells.loc[cells["table"] == "4.1", [*KEY, *SOURCE]]).merge(POLICIES)
    return own.assign(score=normalised(own["task"], own["return_mean"]).round(DECIMALS))


def of_policies(scored: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the interquartile means, a row a policy, and the steps of the profiles, a row a policy and threshold.

    Thresholds are the ends of the axis and the scores between them.
    """
    if scored.empty:
        return pd.DataFrame(columns=COLUMNS_OF_MEANS), pd.DataFrame(columns=COLUMNS)
    ends = [(math.ceil(10 * scored["score"].min()) - 1) / 10, math.ceil(10 * scored["score"].max()) / 10]
    means, lines = [], []
    for method, depth in COLUMNS_OF_TABLE:
        own = scored[(scored["method"] == method) & (scored["depth"] == depth)]
        tasks = [task for task in TASKS if task in set(own["task"])]
        if len(tasks) < MIN_TASKS:
            continue
        of_tasks = [own.loc[own["task"] == task, "score"] for task in tasks]
        policy = dict(zip(OF_POLICY, (method, depth, len(own), len(tasks), " ".join(tasks)), strict=True))
        mean, (low, high) = stratified_iqm(of_tasks)
        means.append(policy | {"iqm": mean, "ci_low": low, "ci_high": high})
        thresholds = np.unique([*ends, *own["score"]])
        shares = [performance_profile(of_tasks, thresholds), *profile_band(of_tasks, thresholds)]
        steps = dict(zip(COLUMNS[len(OF_POLICY) :], (thresholds, *shares), strict=True))
        lines.append(pd.DataFrame(policy | steps))
    return pd.DataFrame(means, columns=COLUMNS_OF_MEANS), pd.concat(lines) if lines else pd.DataFrame(columns=COLUMNS)


def draw_profiles(means: pd.DataFrame, lines: pd.DataFrame) -> Figure:
    """Return a figure of what `of_policies` returns: the means to the left, in their order, best first, the lines."""
    score = "score: 0 for random actions, 1 for the thesis's best"
    titles = ["Interquartile mean, 95 % interval", "Share of runs above a score, 95 % band"]
    figure, (left, right) = figure_of_panels(
        pd.DataFrame({"panel": titles}), 2, 2.4, (score, ""), 2, share=(False, False)
    )
    policies = list(lines.groupby(["method", "depth"], sort=False))
    # Every other line is dashed and lies above the solid ones, so that two that fall together are both seen.
    styles: dict[Any, dict[str, Any]] = {
        policy: {"linestyle": (DASHES, "-")[i % 2], "zorder": 3 - i % 2, "linewidth": 1.2, "markeredgecolor": "white",
                 "markeredgewidth": 0.5, **OF_METHODS[METHOD_NAMES[policy[0]]]}
        for i, (policy, _) in enumerate(policies)
    }  # fmt: skip
    if LARGE in styles:  # as OTR (6), but hollow
        styles[LARGE] |= {"markerfacecolor": "white", "markeredgecolor": styles[LARGE]["color"], "markeredgewidth": 1.2}
    names = []
    for place, mean in enumerate(means.sort_values("iqm").itertuples()):
        style = styles[mean.method, mean.depth]
        left.plot([mean.ci_low, mean.ci_high], [place, place], color=style["color"], linewidth=2)
        left.plot([mean.iqm], [place], **{**style, "markersize": 6})
        tasks = "" if mean.n_tasks == len(TASKS) else f", {mean.n_tasks} tasks"
        names.append(f"{METHOD_NAMES[str(mean.method)]} ({mean.depth}), {mean.n_runs} runs{tasks}")
    left.set_yticks(range(len(names)), names)
    for i, (policy, line) in enumerate(policies):
        style = styles[policy]
        right.step(line["threshold"], line["share"], where="post", markevery=(2 + i, 7), **style)
        right.fill_between(line["threshold"], line["share_low"], line["share_high"], step="post", alpha=0.13,
                           linewidth=0, color=style["color"])  # fmt: skip
    right.margins(x=0, y=0.03)
    handles = [legend_line(f"{METHOD_NAMES[method]} ({depth})", **style) for (method, depth), style in styles.items()]
    set_legend(figure, handles, 7)
    return figure
