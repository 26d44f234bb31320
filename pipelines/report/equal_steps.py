"""Policies at equal cost: what each method returns after a million environment steps, its oracle's counted."""

from math import nan
from pathlib import Path
from typing import Any

import pandas as pd

from pipelines.engine.store import exists, read_csv
from pipelines.report.cells import DECIMALS, METHOD_NAMES, SOURCE, TASK_NAMES, in_order, summarise, table_runs
from pipelines.report.frames import load_runs
from pipelines.report.sizes import steps_in_all
from pipelines.report.text import markdown_table, page, write_tables

STEPS = 1_000_000
ON_THE_WAY = 0.8  # of STEPS, from where on the evaluations of a longer training count
OVER = 1.25  # times STEPS, up to which a policy is shown in brackets
TASKS = tuple(TASK_NAMES)[:8]
LINE = ["method", "depth", "trainer"]
HOW = {"final": "", "on the way": " †"}


def write_equal_steps(results_dir: Path) -> list[Path]:
    """Write `equal_steps.md` and `equal_steps.csv` under `results_dir/tables`: a cell a task, policy and trainer."""
    cells = equal_cells(load_runs(results_dir), results_dir)
    table = markdown_table(_lines(cells), empty="No run has spent as many steps yet.")
    return write_tables(results_dir, "equal_steps", cells.round(DECIMALS), page("equal_steps.md", table=table))


def equal_cells(runs: pd.DataFrame, results_dir: Path) -> pd.DataFrame:
    """Return a row for each task, method, depth and source of `load_runs`, as far as its runs tell it.

    `how` is `final` for policies that took STEPS or fewer, `on the way` for longer trainings and searches that were
    evaluated there, `over` for policies that took up to OVER times as many; `steps` is the mean of what was spent, and
    `n_known_of` the number of runs of which `n_runs` are such.
    """
    own = table_runs(runs, {"tree": "", "polished": "-polished"})
    is_quick = own["budget"].str.startswith("quick")
    own = own[own["task"].isin(TASKS) & ~is_quick]
    found = [_at_equal_steps(run, results_dir) for run in own.to_dict("records")]
    own = own.drop(columns="steps").join(pd.DataFrame(found, own.index, ["value", "steps", "how"]))
    policy = ["task", *LINE[:2], *SOURCE]
    own = own.assign(n_known_of=own.groupby(policy)["seed"].transform("size")).dropna(subset="value")
    further = {"steps": ("steps", "mean"), "n_known_of": ("n_known_of", "first")}
    cells = summarise(own, [*policy, "how"], "value", **further)
    cells = in_order(cells, policy).sort_values("n_runs", key=lambda n: n == 1, kind="stable")
    return in_order(cells.drop_duplicates(["task", *LINE]), ["task", *LINE])


def _at_equal_steps(run: dict[str, Any], results_dir: Path) -> dict[str, Any]:
    """Return a run's return after STEPS, what that took and how it is known; NaN where it is not."""
    total, file = steps_in_all(run), results_dir / "runs" / run["run"] / "train" / "evaluations.csv"
    if total <= STEPS:
        return {"value": run["return_mean"], "steps": total, "how": "final"}
    if run["form"] == "tree" and run["method"] in ("otr", "linear") and exists(file):
        rows = [(float(row["steps"]), float(row["return_mean"])) for row in read_csv(file)]
        passed = [row for row in rows if ON_THE_WAY * STEPS < row[0] <= STEPS]
        if passed and rows[-1][0] > STEPS:
            steps, returns = zip(*passed, strict=True)
            return {"value": sum(returns) / len(returns), "steps": max(steps), "how": "on the way"}
    is_near = total <= OVER * STEPS
    return {"value": run["return_mean"] if is_near else nan, "steps": total, "how": "over"}


def _lines(cells: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for each policy and trainer that has a cell within STEPS, or near it."""
    lines = [["", "Trainer", *(TASK_NAMES[task] for task in TASKS)]]
    for (method, depth, trainer), own in in_order(cells, LINE).groupby(LINE, sort=False):
        by_task = {cell.task: _text(cell) for cell in own.itertuples()}
        name = METHOD_NAMES.get(str(method), str(method)) + ("" if depth == "0" else f" ({depth})")
        lines.append([name, str(trainer), *(by_task.get(task, "-") for task in TASKS)])
    return lines


def _text(cell: Any) -> str:
    digits = 0 if abs(cell.mean) >= 1000 else 1
    text = f"{cell.mean:,.{digits}f}" + (f" ± {cell.std:,.{digits}f}" if cell.n_runs > 1 else "")
    text += f" ({cell.n_runs})" if cell.n_runs == cell.n_known_of else f" ({cell.n_runs} of {cell.n_known_of})"
    return f"[{text}, {cell.steps / 1e6:.2f}M]" if cell.how == "over" else text + HOW[cell.how]
