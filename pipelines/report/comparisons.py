"""Every control policy compared with its task's linear policies and with OTR (6), paired on shared starts."""

import functools
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.engine.store import corrupt, read_bytes
from pipelines.report.cells import (
    DECIMALS,
    FORMS,
    KEY,
    METHOD_NAMES,
    SOURCE,
    TASK_NAMES,
    in_order,
    runs_text,
    table_runs,
)
from pipelines.report.frames import load_runs
from pipelines.report.statistics import (
    difference_interval,
    interquartile_mean,
    mean_interval,
    paired_difference,
    probability_of_improvement,
)
from pipelines.report.text import markdown_table, page, write_tables

LINEAR, RIVALS = "linear", {"linear": "0", "distilled-otr": "0", "otr": "6"}  # methods with their depths
POLISHED = FORMS["polished"]
EPISODES = {"polished": "polish/episodes.csv", "tree": "evaluate/episodes.csv"}
COLUMNS = [*KEY, *SOURCE, "n_runs", "mean", "iqm", "rival", "rival_depth", "rival_budget", "n_rival_runs", "n_starts",
           "difference", "starts_low", "starts_high", "runs_low", "runs_high", "probability"]  # fmt: skip


def write_comparisons(results_dir: Path) -> list[Path]:
    """Write `comparisons.md` and `comparisons.csv` under `results_dir/tables`: a row for each policy and rival.

    A policy of each budget and trainer has rows of its own.
    """
    rows = pd.DataFrame(_rows(results_dir), columns=COLUMNS)
    rows = in_order(rows, [*KEY, *SOURCE]) if len(rows) else rows
    markdown = page("comparisons.md", tables=_tables(rows))
    return write_tables(results_dir, "comparisons", rows.round(DECIMALS), markdown)


def _rows(results_dir: Path) -> Iterator[dict[str, Any]]:
    runs = table_runs(load_runs(results_dir))
    runs = runs.loc[runs["form"].isin(EPISODES), [*KEY, *SOURCE, "run", "form", "return_mean"]]
    for task, own in runs.groupby("task", sort=False):
        cells: dict[Any, pd.DataFrame] = dict(list(in_order(own, SOURCE).groupby([*KEY[1:], *SOURCE], sort=False)))
        starts = functools.cache(lambda key, cells=cells: _returns(results_dir, cells[key]))
        for ours, group in cells.items():
            for rival in RIVALS:
                for theirs in _rivals(cells, ours, rival):
                    row = {"task": task, **dict(zip([*KEY[1:], *SOURCE], ours, strict=True))}
                    row |= {"rival": theirs[0], "rival_depth": theirs[1]}
                    yield row | _compared(group, starts(ours), cells[theirs], starts(theirs))


def _rivals(cells: dict[Any, pd.DataFrame], ours: Any, rival: str) -> list[Any]:
    """Return which runs of a rival are compared with ours: of the same budget before others, then the most there are.

    A polished policy is compared with the polished rival, where there is one, and a polished rival with what it was
    before. No policy is compared with itself, nor the linear row with OTR: that is OTR's own line. Of the same budget
    by several trainers these are those that Table 4.1 shows, the first in its order that has two runs or more, and
    besides those by our own trainer, so that a search is compared with a search.
    """

    def rank(key: Any) -> tuple[bool, int]:
        is_same, n_runs = _level(key) == _level(ours), len(cells[key])
        return is_same, min(n_runs, 2) if is_same else n_runs

    method, polished = ours[0].removesuffix(POLISHED), ours[0].endswith(POLISHED)
    is_own = (method, ours[1]) == (rival, RIVALS[rival])
    if method == LINEAR != rival or (is_own and not polished):
        return []
    theirs = [key for key in cells if key[:2] == (rival, RIVALS[rival])]
    if polished and not is_own:
        theirs = [key for key in cells if key[:2] == (rival + POLISHED, RIVALS[rival])] or theirs
    shown = [max(theirs, key=rank)] if theirs else []
    return shown + [key for key in theirs if key not in shown and key[2:] == ours[2:]]


def _level(key: Any) -> str:
    """Return the budget of a cell, whatever its trainer."""
    budget: str = key[len(KEY) - 1]
    return budget.partition("-")[0]


def _compared(
    ours: pd.DataFrame, our_starts: pd.DataFrame, theirs: pd.DataFrame, their_starts: pd.DataFrame
) -> dict[str, Any]:
    """Return the comparison of two groups of runs, and of their returns (runs, starts) on the starts that both have."""
    both = set(ours["run"]) & set(theirs["run"])
    if both and len(both) in (len(ours), len(theirs)):  # two forms of the same runs, of which some may have one alone
        our_starts, their_starts = our_starts[_of(ours, both)], their_starts[_of(theirs, both)]
        theirs = theirs[_of(theirs, both)]
    shared = our_starts.columns.intersection(their_starts.columns)
    means, rivals = ours["return_mean"].astype(float), theirs["return_mean"].astype(float)
    difference, over_starts = np.nan, (np.nan, np.nan)
    if len(shared):
        difference, over_starts = paired_difference(our_starts[shared], their_starts[shared])
    if both and len(both) == len(theirs):
        after, before = (group.set_index("run")["return_mean"] for group in (ours[_of(ours, both)], theirs))
        gains = (after - before).astype(float)
        over_runs, probability = mean_interval(gains), float(((gains > 0) + (gains == 0) / 2).mean())
    else:
        over_runs, probability = difference_interval(means, rivals), probability_of_improvement(means, rivals)
    return {
        "n_runs": len(means), "mean": means.mean(), "iqm": interquartile_mean(means),
        "rival_budget": theirs["budget"].iloc[0], "n_rival_runs": len(rivals), "n_starts": len(shared),
        "difference": difference, "starts_low": over_starts[0], "starts_high": over_starts[1],
        "runs_low": over_runs[0], "runs_high": over_runs[1],
        "probability": probability,
    }  # fmt: skip


def _of(group: pd.DataFrame, runs: set[str]) -> np.ndarray:
    return np.asarray(group["run"].isin(runs))


def _returns(results_dir: Path, group: pd.DataFrame) -> pd.DataFrame:
    """Return the evaluated returns of runs, a row a run and a column a start's seed; starts that all of them have."""
    files = (results_dir / "runs" / run / EPISODES[form] for run, form in zip(group["run"], group["form"], strict=True))
    return pd.concat([_played(path) for path in files], axis=1, join="inner").T


def _played(path: Path) -> pd.Series:
    """Return the return of each start's seed."""
    try:
        text = read_bytes(path).decode()
        names = text.partition("\n")[0].split(",")
        columns = [names.index(name) for name in ("seed", "return")]
        seeds, returns = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=1, usecols=columns, ndmin=2).T
        return pd.Series(returns, index=seeds.astype(int))
    except (OSError, ValueError) as error:
        raise corrupt(path, error) from error


def _tables(rows: pd.DataFrame) -> str:
    """Return a table for each task, below its name."""
    tables = (
        f"## {TASK_NAMES.get(str(task), task)}\n\n{_table(own)}" for task, own in rows.groupby("task", sort=False)
    )
    return "\n\n".join(tables) or "Nothing has been run yet that could be compared."


def _table(rows: pd.DataFrame) -> str:
    """Return a line for each policy and rival."""
    lines = [["Method", "Depth", "Ours", "IQM", "Against", "Difference", "Over starts", "Over runs", "Better"]]
    for row in rows.itertuples():
        digits = 2 if row.task == "reacher" else 1
        rival = f"{METHOD_NAMES[row.rival]} ({row.rival_depth}), {row.n_rival_runs}, {row.rival_budget}"
        lines.append([
            METHOD_NAMES.get(row.method, row.method), row.depth,
            f"{row.mean:z.{digits}f} ({runs_text(row)})", f"{row.iqm:z.{digits}f}", rival,
            _number(row.difference, digits), _range(row.starts_low, row.starts_high, digits),
            _range(row.runs_low, row.runs_high, digits), f"{row.probability:.2f}",
        ])  # fmt: skip
    return markdown_table(lines)


def _number(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:+z.{digits}f}"


def _range(low: float, high: float, digits: int) -> str:
    return "" if np.isnan(low) else f"{low:+.{digits}f} to {high:+.{digits}f}"  # -0.0 is below zero
