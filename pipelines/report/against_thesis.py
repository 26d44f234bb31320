"""How the cells of Table 4.1 stand against the thesis's, against what others publish, and against what is possible."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.engine.store import exists, read_json
from pipelines.report.cells import METHOD_NAMES, ORACLE, TASK_NAMES, normalised
from pipelines.report.published import published_elsewhere
from pipelines.report.statistics import holm, welch_p_value

LEVEL = 0.05
HIGHER, LOWER, OPEN, IMITATES = "↑", "↓", "○", "†"
OPTIMUM = "benchmarks/pendulum_optimum.json"


def with_marks(cells: pd.DataFrame) -> pd.DataFrame:
    """Return cells with Welch's p-value against the thesis's cell, Holm's correction, and what that says.

    `against_thesis` is higher, lower or open; empty where either has one run, or the thesis has none. It is tested in
    the table's own cells, whose number is what Holm corrects for.
    """
    p_values = [_p_value(cell) if cell.table == "4.1" else np.nan for cell in cells.itertuples()]
    corrected = holm(p_values)
    above = cells["mean"].astype(float) > pd.to_numeric(cells["published_mean"])
    verdicts = np.where(corrected > LEVEL, "open", np.where(above, "higher", "lower"))
    return cells.assign(p_value=p_values, p_holm=corrected, against_thesis=np.where(np.isnan(corrected), "", verdicts))


def mark_of(cell: Any) -> str:
    """Return a cell's symbols: how it stands against the thesis's, and whether it imitates a policy of the table."""
    mark = {"higher": HIGHER, "lower": LOWER, "open": OPEN, "": ""}[cell.against_thesis]
    return mark + (IMITATES if cell.imitates else "")


def verdict_counts(cells: pd.DataFrame) -> str:
    """Return how many of the tested cells are higher, lower and open."""
    counts = cells.loc[cells["against_thesis"] != "", "against_thesis"].value_counts()
    named = ", ".join(f"{counts.get(name, 0)} are {name}" for name in ("higher", "lower", "open"))
    return f"of {counts.sum()} cells {named}"


def order_of_methods(cells: pd.DataFrame) -> list[list[str]]:
    """Return a head and two lines: mean normalised returns, ours and the thesis's, of methods with every task."""
    table = cells[(cells["table"] == "4.1") & (cells["method"] != ORACLE)]
    ours, theirs = (_mean_scores(table, column) for column in ("mean", "published_mean"))
    order = ours.sort_values(ascending=False).index
    head = ["mean return, 0 random, 1 the thesis's best"]
    head += [f"{METHOD_NAMES[method]} ({depth})" for method, depth in order]
    lines = [[name, *map(_share, scores.reindex(order))] for name, scores in {"ours": ours, "thesis": theirs}.items()]
    return [head, *lines]


def pendulum_note(results_dir: Path, cells: pd.DataFrame) -> str:
    """Return how far the pendulum's best policy is from the optimum, as a note; nothing where that is not known."""
    own = cells[(cells["task"] == "pendulum") & (cells["method"] != ORACLE) & (cells["n_runs"] > 0)]
    if not exists(results_dir / OPTIMUM) or own.empty:
        return ""
    (entry,) = read_json(results_dir / OPTIMUM)
    best, optimum, details = own.loc[own["mean"].astype(float).idxmax()], entry["value"], entry["details"]
    theirs, deviation = pd.to_numeric(own["published_mean"]).max(), details["std_of_means_of_100"]
    name = f"{METHOD_NAMES[best['method']]}{f' ({depth})' if (depth := best['depth']) else ''}"
    return (
        f"* Pendulum: the optimum is a mean return of {optimum:.1f} over our {details['n_starts']:,.0f} starts "
        "(value iteration on angle and rate, `python -m benchmarks pendulum_optimum`). The best here, "
        f"{name}, returns {best['mean']:.1f}, which is {optimum - best['mean']:.1f} less. The optimum's means of 100 "
        f"starts have a standard deviation of {deviation:.1f}: the thesis's best, {theirs:.1f} on 100 starts of its "
        f"own, is {abs(theirs - optimum) / deviation:.1f} of it from the optimum. The "
        "marks of the pendulum's cells do not take this into account.\n"
    )


def elsewhere() -> list[list[str]]:
    """Return a head and a line for each policy that others have published."""
    lines = [["Task", "Policy", "Return", "Steps", "Numbers", "Source", "Note"]]
    for row in published_elsewhere():
        spread = f" ± {row['std']}" if row["std"] else ""
        steps = f"{int(row['steps']):,}" if row["steps"] else ""
        env = f" ({row['env_id']})" if row["env_id"] else ""
        lines.append([TASK_NAMES[row["task"]] + env, row["method"], row["mean"] + spread, steps, row["numbers"],
                      row["source"], row["note"]])  # fmt: skip
    return lines


def _p_value(cell: Any) -> float:
    if not (cell.n_runs and cell.published_std and cell.published_n_runs):
        return np.nan
    theirs = float(cell.published_mean), float(cell.published_std), float(cell.published_n_runs)
    return welch_p_value((cell.mean, cell.std, cell.n_runs), theirs)


def _mean_scores(table: pd.DataFrame, column: str) -> "pd.Series[float]":
    scores = normalised(table["task"], pd.to_numeric(table[column]))
    each = table.assign(score=scores).groupby(["method", "depth"])["score"]
    return each.mean().where(each.count() == table["task"].nunique())


def _share(score: float) -> str:
    return "-" if np.isnan(score) else f"{score:.3f}".removeprefix("0")
