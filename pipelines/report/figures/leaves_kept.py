"""The return against the number of leaves kept, OTR-hat(k), of finished runs with the stage leaves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from pipelines.engine.store import corrupt, exists, read_csv, read_json
from pipelines.errors import MissingInputError
from pipelines.report.figures.style import (
    NORMAL,
    figure_of_panels,
    legend_line,
    panel_and_label,
    set_leaf_ticks,
    set_legend,
    styles_of,
)
from pipelines.runs.finished_run import command_of
from pipelines.stages.leaves import COLUMNS, numbers_of_leaves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def load_leaves(run_dirs: Sequence[Path]) -> pd.DataFrame:
    """Return a row for each run and number of leaves kept, of the runs that have the stage leaves.

    Columns: `panel` (the environment), `label` (method, depth, budget, what else is set, and "polished"), `run` (the
    folder), and those of the stage's `returns.csv`.

    Raises:
        MissingInputError: none of the runs has it; names the command.
    """
    rows: list[dict[str, Any]] = []
    for run_dir in run_dirs:
        if not exists(run_dir / "leaves" / "returns.csv"):
            continue
        place = panel_and_label(run_dir)
        if read_json(run_dir / "leaves" / "report.json").get("policy") == "polished":
            place["label"] += ", polished"
        for row in read_csv(run_dir / "leaves" / "returns.csv"):
            try:
                numbers = {name: float(row[name]) for name in COLUMNS}
            except (KeyError, TypeError, ValueError) as error:
                raise corrupt(run_dir / "leaves" / "returns.csv", ValueError(f"its row {row}")) from error
            rows.append({**place, "run": str(run_dir), **numbers})
    if not rows:
        command = command_of(run_dirs[0], "evaluate")
        raise MissingInputError(
            f"{run_dirs[0]}: stage leaves, which plays with fewer leaves, is not finished there\n"
            f"Run: {command} leaves=true"
        )
    return pd.DataFrame(rows).astype({"n_leaves": int, "n_episodes": int})


def return_against_leaves(points: pd.DataFrame) -> Figure:
    """Return a figure of the return against the number of leaves kept, a panel for each environment.

    Of a label with several runs, thin lines are the runs and the thick one is their mean, to which a run whose leaves
    are all kept adds the return with all of them. A marker is a run with all leaves that it reaches, of which the
    legend has the mean.

    Args:
        points: as `load_leaves` returns it.
    """
    styles = styles_of(points["label"])
    n_columns = min(points["panel"].nunique(), 3)
    axes = ("leaves kept, the most visited (log scale)", "return")
    figure, panels = figure_of_panels(points, n_columns, max(n_columns, 1.7), axes, len(styles) + 1)
    for panel, (_, own) in zip(panels, points.groupby("panel", sort=False), strict=True):
        for label, of_label in own.groupby("label", sort=False):
            _draw(panel, of_label, styles[str(label)])
        panel.set_xscale("log", base=2)
    set_leaf_ticks(panels[0], points["n_leaves"].max())
    whole = points.loc[points.groupby("run")["n_leaves"].idxmax()].groupby("label")
    handles = [legend_line(f"{label}: {_in_words(whole.get_group(label))}", **styles[label]) for label in styles]
    set_legend(figure, handles, 1)
    n_episodes, n_runs = points["n_episodes"].max(), points["run"].nunique()
    several = f"; {n_runs} runs, thick: their mean" if (points.groupby("label")["run"].nunique() > 1).any() else ""
    figure.suptitle(f"mean over {n_episodes} episodes{several}", fontsize=NORMAL)
    return figure


def _in_words(whole: pd.DataFrame) -> str:
    fewest, most = whole["n_leaves"].min(), whole["n_leaves"].max()
    reached = f"{fewest:,}" if fewest == most else f"{fewest:,} to {most:,}"
    return f"{whole['return_mean'].mean():.1f} with all {reached} leaves (marker)"


def _draw(panel: Axes, points: pd.DataFrame, style: dict[str, Any]) -> None:
    line = {"color": style["color"]}
    runs = [run.set_index("n_leaves")["return_mean"].sort_index() for _, run in points.groupby("run", sort=False)]
    for run in runs:
        alone = len(runs) == 1
        panel.plot(run.index, run, linewidth=1.8 if alone else 0.7, alpha=1 if alone else 0.45, **line)
        panel.plot(
            run.index[-1:], run.iloc[-1:], linestyle="none", markeredgecolor="white", markeredgewidth=0.5, **style
        )
    if len(runs) > 1:
        mean = mean_return(runs)
        panel.plot(mean.index, mean, linewidth=1.8, **line)


def mean_return(runs: Sequence[pd.Series]) -> pd.Series:
    """Return the mean of the runs' returns by the number of leaves kept, at powers of two and at the largest number.

    A run that reaches fewer leaves keeps all of them there, so that its last return stays.
    """
    last = max(int(run.index[-1]) for run in runs)
    at = list(numbers_of_leaves(last))
    return pd.concat([run.reindex(run.index.union(at)).ffill().loc[at] for run in runs], axis=1).mean(axis=1)
