"""Return against the numbers of the written tree: a panel for each task of Table 4.1, and one for their mean.

A point is a policy of one method, depth and form, plain or polished: the mean over its runs, under the budget that
Table 4.1 shows. The step line is the front: the most that any of ours returns with as many numbers or fewer. Stars are
what others have published; they are no part of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import otr
from pipelines.engine.command_text import command_text
from pipelines.errors import MissingInputError
from pipelines.report.cells import BY_CRITICS, DECIMALS, KEY, TASK_NAMES, in_order, normalised, table_runs
from pipelines.report.figures.style import (
    DOTS,
    GREY,
    INK,
    OF_METHODS,
    SMALL,
    figure_of_panels,
    legend_line,
    set_legend,
)
from pipelines.report.published import published_elsewhere
from pipelines.report.sizes import with_sizes
from pipelines.report.table_4_1 import TASKS, make_cells
from pipelines.report.text import csv_text, write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SERIES = {"linear": "Linear", "viper": "VIPER", "lm-viper": "LM-VIPER", "ndps": "NDPS", "pi-prl": "π-PRL",
          "experts": "Experts", "distilled-otr": "OTR, distilled", "otr": "OTR"}  # fmt: skip # OTR is drawn on top
MEAN = "Mean of the eight tasks"
STAR: dict[str, Any] = {"marker": "*", "markersize": 10, "markerfacecolor": "white", "markeredgecolor": INK}
COLUMNS = ["task", "method", "depth", "n_runs", "mean", "score", "leaves", "free_numbers", "written_numbers",
           "on_front"]  # fmt: skip
LOWEST, HIGHEST = -0.04, 1.12  # that is drawn: what is worse or better is on the edge


def write_numbers(results_dir: Path, runs: pd.DataFrame) -> list[Path]:
    """Write `numbers.csv`, a row a point, and the picture under `results_dir/figures`.

    Raises:
        MissingInputError: nothing of Table 4.1 has been run; names the command.
    """
    points = points_of(with_sizes(table_runs(runs), results_dir))
    if points.empty:
        raise MissingInputError(
            f"{results_dir}: no tree of Table 4.1's tasks has been run.\n"
            f"Run: {command_text('otr-run', ['+experiment=table_4_1'], results_dir)}"
        )
    path = write_file(results_dir / "figures" / "numbers.csv", csv_text(points[COLUMNS].round(DECIMALS)))
    otr.save_picture(draw_numbers(points), path.with_suffix(".png"))
    return [path, path.with_suffix(".png")]


def points_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the points: a row a task and policy, and the means of policies that were run on every task.

    Scores are `normalised`; a mean's numbers are the geometric mean.
    """
    cells = make_cells(runs)
    own = cells[cells["task"].isin(TASKS) & (cells["table"] != "other") & (cells["written_numbers"] > 0)]
    own = own.assign(series=own["method"].map(_series))
    own = own[own["series"].isin(SERIES)]
    own = in_order(own.assign(score=normalised(own["task"], own["mean"])), ["task"])
    of_policy = own.groupby(KEY[1:], sort=False)
    sizes = ["leaves", "free_numbers", "written_numbers"]
    means = of_policy.agg(
        n_runs=("n_runs", "sum"), score=("score", "mean"), n_tasks=("task", "size"), series=("series", "first"),
        **{size: (size, lambda numbers: np.exp(np.log(numbers).mean())) for size in sizes},
    ).reset_index()  # fmt: skip
    points = pd.concat([own, means[means["n_tasks"] == len(TASKS)].assign(task=MEAN)], ignore_index=True)
    fronts = [_on_front(group) for _, group in points.groupby("task", sort=False)]
    return points.assign(on_front=pd.concat(fronts) if fronts else False)


def draw_numbers(points: pd.DataFrame) -> Figure:
    """Return a figure of the points, as `points_of` returns them."""
    axes = ("numbers in the written tree (log scale)", "return, 0 random, 1 thesis's best")
    names = points.assign(panel=points["task"].replace(TASK_NAMES))
    figure, panels = figure_of_panels(names, 3, 3, axes, 2, (True, True))
    styles = {name: OF_METHODS[label] for name, label in SERIES.items()}
    most = float(points["written_numbers"].max())
    for panel, (_, own) in zip(panels, points.groupby("task", sort=False), strict=True):
        _draw_panel(panel, own, styles, most)
    panels[0].set_xscale("log")
    panels[0].set_ylim(LOWEST - 0.04, HIGHEST + 0.04)
    shown = [name for name in SERIES if (points["series"] == name).any()]
    marks = [legend_line(SERIES[name], linestyle="none", markeredgecolor="white", markeredgewidth=0.5, **styles[name])
             for name in shown]  # fmt: skip
    marks.append(legend_line("front of ours", color=INK, linewidth=1))
    marks.append(legend_line("published elsewhere", linestyle="none", **STAR))
    set_legend(figure, marks, 5)
    return figure


def _draw_panel(panel: Axes, points: pd.DataFrame, styles: dict[str, dict[str, Any]], most: float) -> None:
    panel.axhline(1, color=GREY, linestyle=DOTS, linewidth=1, zorder=1)
    front = points[points["on_front"]].sort_values("written_numbers")
    sizes, scores = [*front["written_numbers"], most], [*front["score"], front["score"].max()]
    panel.step(sizes, scores, where="post", color=INK, linewidth=0.8, zorder=2)
    for name, style in styles.items():
        own = points[points["series"] == name]
        panel.plot(own["written_numbers"], own["score"].clip(LOWEST, HIGHEST), linestyle="none", zorder=3,
                   markeredgecolor="white", markeredgewidth=0.5, **style)  # fmt: skip
    task = points["task"].iloc[0]
    for point in points[(points["method"] == "otr") & (task == MEAN)].itertuples():
        panel.annotate(f"OTR ({point.depth})", (point.written_numbers, point.score), (5, -10), fontsize=SMALL - 1,
                       textcoords="offset points", color=INK)  # fmt: skip
    others = pd.DataFrame(published_elsewhere())
    others = others[(others["task"] == task) & (others["numbers"] != "")]
    for other, score in zip(others.itertuples(), normalised(others["task"], others["mean"]), strict=True):
        place = float(str(other.numbers)), min(score, HIGHEST)
        panel.plot(*place, linestyle="none", zorder=4, **STAR)
        text = str(other.method).split("'")[0] + (f", {score:.2f}" if score > HIGHEST else "")
        panel.annotate(text, place, (6, -3), fontsize=SMALL - 1, textcoords="offset points", color=INK)


def _series(method: str) -> str:
    plain = method.removesuffix("-polished").removesuffix(BY_CRITICS)
    return "experts" if plain == "distilled-experts" else plain


def _on_front(points: pd.DataFrame) -> pd.Series:
    """Return whether no other point has a higher score with as few numbers, or as high a one with fewer."""
    ordered = points.sort_values(["written_numbers", "score"], ascending=[True, False], kind="stable")
    before = ordered["score"].cummax().shift(fill_value=-np.inf)
    return ordered["score"] > before
