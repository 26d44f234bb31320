"""Learning curves of one run or of all runs below a folder: the return of every policy that was judged on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os.path import commonpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from pipelines.engine.store import exists, read_csv, read_summary
from pipelines.errors import MissingInputError
from pipelines.report.figures.style import (
    NORMAL,
    OF_LINES,
    figure_of_panels,
    legend_line,
    line_styles,
    panel_and_label,
    set_legend,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Style = dict[str, Any]  # of a line
CROSS: Style = {"marker": "x", "markersize": 6, "markeredgewidth": 1.5}
LOG_FROM = 8  # times that what one label spent is more than another: the axis is logarithmic
STEPS, ROWS = "environment steps", "rows that the imitator learnt from"
# A stage and its file, its column of what was spent, those of the return's mean and deviation, and of the chosen one.
SOURCES = (
    ("train", "evaluations.csv", STEPS, "steps", "return_mean", "return_std", "best"),
    ("imitate", "iterates.csv", ROWS, "n_rows", "selection_mean", None, "chosen"),
)


def load_curves(run_dirs: Sequence[Path]) -> pd.DataFrame:
    """Return a row for each judged policy of the finished stages train and imitate.

    A run that critics have polished has rows of that polish instead, by all the environment steps that went into it:
    its oracle's, the imitation's and those that filled the replay buffer. Its first is the imitator.

    Columns: `panel` (the environment), `label` (method, depth, budget and what else is set, the steps apart, which a
    curve shows), `run` (the folder), `spent` in units of `unit`, `mean` and `std` (of the return; NaN where no
    deviation is kept), `chosen`, and `final`, the return of the tree over the evaluation episodes (NaN of an unfinished
    run).

    Raises:
        MissingInputError: none of the runs has been trained, or imitates.
    """
    rows: list[dict[str, Any]] = []
    for run_dir in run_dirs:
        place = panel_and_label(run_dir, but=["train.steps"])
        summary = read_summary(run_dir)
        final = summary.get("return_mean")
        if summary.get("polish", {}).get("by") == "critic":
            final = summary["polish"]["return_mean"]
            about = {**place, "run": str(run_dir), "unit": STEPS, "std": float("nan"), "final": final}
            rows += [about | row for row in _rows_of_polish(run_dir, summary)]
            continue
        for stage, file, unit, spent, mean, std, chosen in SOURCES:
            judged = read_csv(run_dir / stage / file) if exists(run_dir / stage / file) else []
            is_chosen = [str(row[chosen]) == "True" for row in judged]
            last_best = max((i for i, best in enumerate(is_chosen) if best), default=-1)
            for i, row in enumerate(judged):
                rows.append({
                    **place, "run": str(run_dir), "unit": unit, "spent": float(row[spent]),
                    "mean": float(row[mean]), "std": float(row[std]) if std else float("nan"), "chosen": i == last_best,
                    "final": float("nan") if final is None else float(final),
                })  # fmt: skip
    if not rows:
        where = f"{commonpath([path.absolute() for path in run_dirs])}: " if run_dirs else ""
        raise MissingInputError(
            f"{where}no learning curve is kept there; a run has one once it is trained, and programs "
            "(method=program) are not trained"
        )
    return pd.DataFrame(rows)


def _rows_of_polish(run_dir: Path, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what was spent on each candidate of a polish by critics, its return, and whether it was kept."""
    polish = summary["polish"]
    learnt_from = summary["total_steps"] - polish["n_learning_steps"]
    last = polish["best_iteration"] if polish["kept"] else 0
    return [
        {
            "spent": float(learnt_from + iteration if iteration else learnt_from - polish["n_refill_steps"]),
            "mean": float(row["selection_mean"]),
            "chosen": iteration == last,
        }
        for row in read_csv(run_dir / "polish" / "candidates.csv")
        for iteration in [int(row["iteration"])]
    ]


def curve_rows(curves: pd.DataFrame) -> pd.DataFrame:
    """Return curves as `load_curves` does in long form: env, method, depth, budget, seed, step, unit, metric, value.

    The metrics are `return_mean` and, where it is kept, `return_std`, both over the episodes that chose the policy.
    """
    place = [Path(run).parts[-5:] for run in curves["run"]]
    rows = pd.DataFrame(place, columns=["env", "method", "depth", "budget", "seed"]).assign(
        step=curves["spent"].astype(int), unit=curves["unit"], return_mean=curves["mean"], return_std=curves["std"]
    )
    for name in ("depth", "seed"):
        rows[name] = rows[name].str.removeprefix(f"{name}-")
    return rows.melt([*rows.columns[:7]], var_name="metric").dropna(subset="value")


def learning_curves(curves: pd.DataFrame) -> Figure:
    """Return a figure of the return against what was spent on it, a panel for each environment.

    Of a label with one run, the line is the mean over the selection episodes, and the band one standard deviation to
    either side; of one with several, thin lines are the runs and the thick one is their mean. A dot is the policy that
    was chosen, and a cross at the run's end the return of its tree over the evaluation episodes, which decided nothing.

    Args:
        curves: as `load_curves` returns it.
    """
    labels = list(dict.fromkeys(curves["label"]))
    styles = line_styles(labels)
    n_panels = curves["panel"].nunique()
    units = " or ".join(dict.fromkeys(curves["unit"]))
    n_columns = min(n_panels, 3)
    figure, panels = figure_of_panels(
        curves, n_columns, max(n_columns, 1.7), (units, "return"), len(labels) + 1, share=(False, False)
    )
    for panel, (_, own) in zip(panels, curves.groupby("panel", sort=False), strict=True):
        for label, of_label in own.groupby("label", sort=False):
            _draw(panel, of_label, styles[str(label)])
        panel.margins(x=0.02)
        spent = own.groupby("label")["spent"].max()
        if spent.max() > LOG_FROM * spent.min():
            panel.set_xscale("log")
        panel.xaxis.set_major_formatter(lambda value, _: _count(value))
    handles = [legend_line(label, linewidth=1.8, **styles[label]) for label in labels]
    handles.append(legend_line("chosen", color="none", marker="o", markerfacecolor="#444444", markeredgecolor="white"))
    if curves["final"].notna().any():
        handles.append(legend_line("its tree, evaluated", color="#444444", linestyle="none", **CROSS))
    set_legend(figure, handles, 2, OF_LINES)
    if (n_runs := curves["run"].nunique()) > 1:
        figure.suptitle(f"{n_runs} runs; thick: their mean", fontsize=NORMAL)
    return figure


def _draw(panel: Axes, curves: pd.DataFrame, style: Style) -> None:
    colour = style["color"]
    runs = [run.sort_values("spent") for _, run in curves.groupby("run", sort=False)]
    for run in runs:
        alone = len(runs) == 1
        panel.plot(run["spent"], run["mean"], linewidth=1.8 if alone else 0.7, alpha=1 if alone else 0.45, **style)
        if alone and run["std"].notna().all():
            low, high = run["mean"] - run["std"], run["mean"] + run["std"]
            panel.fill_between(run["spent"], low, high, color=colour, alpha=0.15, linewidth=0)
        best = run[run["chosen"]]
        panel.plot(best["spent"], best["mean"], "o", color=colour, markersize=5, markeredgecolor="white", zorder=4)
        panel.plot(run["spent"].iloc[-1], run["final"].iloc[0], color=colour, clip_on=False, zorder=5, **CROSS)
    if len(runs) > 1:
        mean = _mean(runs)
        panel.plot(mean.index, mean, linewidth=1.8, **style)


def _mean(runs: Sequence[pd.DataFrame]) -> pd.Series:
    """Return the mean of the runs' returns, each taken as straight between two policies, where all have a value."""
    lines = [run.groupby("spent")["mean"].last() for run in runs]
    first, last = max(line.index[0] for line in lines), min(line.index[-1] for line in lines)
    whole = pd.concat(lines, axis=1).sort_index().interpolate("index", limit_area="inside")
    return whole.loc[first:last].mean(axis=1, skipna=False)


def _count(value: float) -> str:
    """Return a number of steps: 250k, 1.5M."""
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"
