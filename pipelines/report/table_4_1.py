"""Table 4.1, return of tree policies on control tasks: from finished runs, as Markdown, CSV and LaTeX."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.config.methods import METHODS
from pipelines.report.against_thesis import (
    elsewhere,
    mark_of,
    order_of_methods,
    pendulum_note,
    verdict_counts,
    with_marks,
)
from pipelines.report.cells import (
    CSV_COLUMNS,
    DECIMALS,
    FORMS,
    KEY,
    METHOD_NAMES,
    ORACLE,
    SOURCE,
    TASK_NAMES,
    beside_the_thesis,
    in_order,
    oracle_runs,
    other_runs,
    runs_text,
    summarise,
    table_runs,
    variant_runs,
    with_pruned_trees,
)
from pipelines.report.frames import load_runs
from pipelines.report.published import published_steps
from pipelines.report.sizes import SIZES, with_sizes
from pipelines.report.statistics import MIN_RUNS_FOR_INTERVAL
from pipelines.report.text import latex_grid, latex_notes, markdown_grid, markdown_table, page, write_tables
from pipelines.report.to_run import to_run

COLUMNS = (("linear", "0"), (ORACLE, ""), ("viper", "6"), ("lm-viper", "6"), ("ndps", "6"), ("pi-prl", "6"),
           ("otr", "6"), ("otr", "32"))  # fmt: skip
HEAD = ["Task", "", *(METHOD_NAMES[method] + (f" ({depth})" if depth else "") for method, depth in COLUMNS)]
TASKS = tuple(TASK_NAMES)[:8]  # in the thesis's order
TABLE = [(task, *column) for task in TASKS for column in COLUMNS]
TEXT = [("mountaincar", "otr", "1"), ("lunarlander", "otr", "2"), ("lunarlander", "sdt-soft", "5"),
        ("lunarlander", "sdt-discrete", "5"), ("lunarlander", "cdt", "3-3"), ("lunarlander", "augtree", "2"),
        ("pendulum", "pid", "1")]  # fmt: skip # what chapter 4 reports outside its tables
# Of each task, below the table: the lines, and the columns of cells that they show.
DETAILS = {
    "runs": "runs", "steps": "total_steps_text", "steps, thesis": "published_steps_text",
    "leaves": "leaves_text", "numbers, free": "free_numbers_text", "numbers, written": "written_numbers_text",
}  # fmt: skip
FURTHER_COLUMNS = [*SIZES, "published_steps", "p_value", "p_holm", "against_thesis", "imitates"]
LEAST_CHANGE = 0.01  # of the return, from which on a pruned tree is listed in addition to the whole one


def write_table_4_1(results_dir: Path) -> list[Path]:
    """Write Table 4.1, return and standard deviation on the eight control tasks, and the runs beyond it."""
    every = load_runs(results_dir)
    runs = with_sizes(pd.concat([table_runs(every), oracle_runs(every)]), results_dir)
    cells = make_cells(runs)
    table = cells["table"] == "4.1"
    rows = {TASK_NAMES[task]: row for task, row in cells[table].groupby("task", sort=False)}
    markdown = page(
        "table_4_1.md",
        table=markdown_grid(HEAD, rows, {"ours": "shown", "thesis": "thesis"}),
        verdicts=verdict_counts(cells),
        order=markdown_table(order_of_methods(cells)),
        pendulum=pendulum_note(results_dir, cells),
        details=markdown_grid(HEAD, rows, DETAILS),
        provenance=markdown_table(_provenance(cells, runs), empty="Nothing of this table has been run yet."),
        beyond=markdown_table(_beyond(cells[~table])),
        elsewhere=markdown_table(elsewhere()),
        pruned=markdown_table(_pruned(every), empty="Nothing has been run yet that pruning changes."),
        least_change=f"{100 * LEAST_CHANGE:.0f} %",
        to_run=markdown_table(to_run(pd.concat([table_runs(every).assign(changes=""), variant_runs(every)]))),
        variants=markdown_table(_variants(every), empty="No run of the table's tasks changes a setting."),
        others=_others(other_runs(every)),
        min_runs=MIN_RUNS_FOR_INTERVAL,
    )
    advice = r"\usepackage{booktabs}; wide: use it within \resizebox or on a landscape page. Costs and sizes follow."
    tables = [latex_grid(HEAD, rows, lines) for lines in ({"ours": "shown", "thesis": "thesis"}, DETAILS)]
    frame = cells[list(CSV_COLUMNS) + FURTHER_COLUMNS].round(DECIMALS)
    latex = latex_notes(advice, markdown) + "\n".join(tables)
    return write_tables(results_dir, "table_4_1", frame, markdown, latex)


def make_cells(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the table's cells, then those of its text and of other runs, then what else there is for the table's.

    A cell is of one budget and trainer: the first with two runs or more in the order of `in_order`, else the first. Its
    `table` is 4.1, text or other.
    """
    sizes = {name: (name, "mean") for name in SIZES if name in runs}
    found = in_order(summarise(
        runs, [*KEY, *SOURCE], "return_mean", best=("return_mean", "max"), n_episodes=("n_episodes", "min"),
        most_episodes=("n_episodes", "max"), pruned_depth=("pruned_depth", lambda depths: depths.mean(skipna=False)),
        oracle=("oracle.hidden_widths", "first"), **sizes,
    ), SOURCE).sort_values("n_runs", key=lambda n: n == 1, kind="stable")  # fmt: skip
    rest = found.duplicated(KEY)
    text = {*found[KEY].itertuples(index=False, name=None), *TEXT} - {*TABLE}
    table = pd.DataFrame(TABLE, columns=KEY).assign(table="4.1")
    keys = [table, in_order(pd.DataFrame(sorted(text), columns=KEY), KEY).assign(table="text")]
    cells = pd.concat([
        pd.concat(keys).merge(found[~rest], how="left", on=KEY),
        table.assign(table="other").merge(found[rest], on=KEY),
    ], ignore_index=True)  # fmt: skip
    tables = cells["table"].replace("other", "4.1")
    cells = beside_the_thesis(cells, zip(tables, cells["task"], cells["method"], cells["depth"], strict=True))
    also = defaultdict(list)
    for cell in found[rest].itertuples():
        also[cell.task, cell.method, cell.depth].append(f"also {_ours(cell)} ({runs_text(cell)})")
    cells["note"] = ["; ".join(_notes(cell, also[cell.task, cell.method, cell.depth])) for cell in cells.itertuples()]
    columns = {"ours": _ours, "runs": _runs, "imitates": _imitates}
    cells = with_marks(cells.assign(**{name: list(map(text, cells.itertuples())) for name, text in columns.items()}))
    cells["shown"] = [f"{cell.ours} {mark_of(cell)}".rstrip() for cell in cells.itertuples()]
    cells["published_steps"] = list(map(published_steps, cells["task"], cells["method"]))
    return cells.assign(**{f"{name}_text": cells[name].map(_short) for name in ("published_steps", *sizes)})


def _notes(cell: Any, also: list[str]) -> Iterable[str]:
    """Yield what a reader of the cell should know; `also` is what other budgets and trainers have run."""
    if cell.table == "other":
        yield "beside the table's cell, by another budget or trainer"
        return
    if not cell.n_runs:
        yield "not run"
    if cell.published_note:
        yield cell.published_note
    if cell.published_n_runs == "1" and cell.n_runs > 1:
        yield f"the best run: {cell.best:z.1f}"
    if cell.method == ORACLE and cell.n_runs:
        yield f"hidden layers {cell.oracle}"
    elif cell.pruned_depth >= 0 and (cell.table == "text" or cell.depth == "32"):
        theirs = cell.published_pruned_depth
        yield f"pruned depth {cell.pruned_depth:.1f}" + (f" (published {theirs})" if theirs else "")
    if cell.n_runs and cell.n_episodes != cell.most_episodes:
        yield f"episodes differ between runs: {cell.n_episodes:.0f} to {cell.most_episodes:.0f}"
    yield from also


def _provenance(cells: pd.DataFrame, runs: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for each task, budget and trainer in the cells: what was run, on what, for how long."""
    lines = [
        ["Task", "Budget", "Trainer", "Steps of training", "Algorithm", "Episodes", "Environment", "Gymnasium", "Runs"]
    ]
    shown, by = in_order(runs.merge(cells[[*KEY, *SOURCE]]), ["task", *SOURCE]), ["task", *SOURCE]
    for (task, budget, trainer), group in shown.groupby(by, sort=False):
        steps = " or ".join(f"{number:,}" for number in sorted(set(group["steps"])))
        episodes = " or ".join(map(str, sorted(set(group["n_episodes"]))))
        algorithms, env_ids, versions = (
            ", ".join(sorted(set(group[name]))) for name in ("algorithm", "env_id", "versions.gymnasium")
        )
        lines.append([TASK_NAMES.get(task, task), budget, trainer, steps, algorithms.upper(), episodes, env_ids,
                      versions, str(group["run"].nunique())])  # fmt: skip
    return lines


def _ours(cell: Any) -> str:
    """Return `mean ± std [pruned depth]`, the brackets at depth 32 only, as in the thesis; or "not run"."""
    if not cell.n_runs:
        return "not run"
    decimals = 2 if cell.task == "reacher" else 1
    spread = f" ± {cell.std:.{decimals}f}" if cell.n_runs > 1 else ""
    pruned = f" [{cell.pruned_depth:.1f}]" if cell.depth == "32" and cell.pruned_depth >= 0 else ""
    return f"{cell.mean:z.{decimals}f}{spread}{pruned}"


def _imitates(cell: Any) -> str:
    """Return the policy of the table whose runs a cell's trees imitate, which is then their oracle; else nothing."""
    depth = str(cell.oracle).strip("[]")
    is_imitator = cell.n_runs and cell.method != ORACLE and ("otr", depth) in COLUMNS
    return f"{METHOD_NAMES['otr']} ({depth})" if is_imitator else ""


def _runs(cell: Any) -> str:
    """Return the runs of a cell, `3 of 5` where some are missing, and the layers of its oracle, or of what it is."""
    text, n_missing = runs_text(cell), MIN_RUNS_FOR_INTERVAL - cell.n_runs
    if cell.table == "4.1" and cell.n_runs and n_missing > 0:
        text = f"{cell.n_runs} of {MIN_RUNS_FOR_INTERVAL} runs{text[text.index(',') :]}"
    return text + (f", of {cell.oracle.replace(',', ', ')}" if cell.n_runs and pd.notna(cell.oracle) else "")


def _short(number: float) -> str:
    """Return a number with three digits, such as 104M or 376k; nothing for NaN."""
    if pd.isna(number):
        return ""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if number >= 0.9995 * size:
            shown = number / (1e3 if letter == "k" else size)
            return f"{float(f'{shown:.3g}'):g}{letter}"
    return f"{number:,.0f}"


def _beyond(cells: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for each cell that is not in the table."""
    lines = [["Task", "Method", "Depth", "Ours", "Thesis", "Steps in all", "Leaves", "Free", "Written", "Note"]]
    for cell in cells.itertuples():
        name, method = TASK_NAMES.get(cell.task, cell.task), METHOD_NAMES.get(cell.method, cell.method)
        note = cell.note.removeprefix("not run").removeprefix("; ")
        ours = f"{cell.ours} ({cell.runs})" if cell.runs else cell.ours
        sizes = cell.total_steps_text, cell.leaves_text, cell.free_numbers_text, cell.written_numbers_text
        lines.append([name, method, cell.depth, ours, cell.thesis, *sizes, note])
    return lines


def _pruned(every: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for each policy of which a run's return changes once it is pruned: means over runs."""
    lines = [["Task", "Method", "Depth", "Whole tree", "Pruned tree", "Changes", "Acts alike", "Leaves"]]
    whole = table_runs(every, {form: FORMS[form] for form in ("tree", "polished")})
    runs = in_order(with_pruned_trees(whole, every), [*KEY, *SOURCE])
    runs["change"] = (runs["return_pruned"] - runs["return_mean"]) / runs["return_mean"].abs()
    for (task, method, depth, *_), group in runs.groupby([*KEY, *SOURCE], sort=False):
        if group["change"].abs().max() >= LEAST_CHANGE:
            digits = 2 if task == "reacher" else 1
            alike = group["fidelity"].where(group["form"] == "tree").mean()
            lines.append([TASK_NAMES.get(task, task), METHOD_NAMES.get(method, method), depth,
                          f"{group['return_mean'].mean():z.{digits}f} "
                          f"({runs_text(group.assign(n_runs=len(group)).iloc[0])})",
                          f"{group['return_pruned'].mean():z.{digits}f}",
                          ", ".join(f"{100 * change:+z.1f}" for change in group.sort_values("seed")["change"]) + " %",
                          "" if np.isnan(alike) else f"{100 * alike:.1f} %",
                          f"{group['leaves_pruned'].mean():,.0f}"])  # fmt: skip
    return lines


def _others(runs: pd.DataFrame) -> str:
    """Return the section of other environments; nothing where none has been run."""
    lines = [["Environment", "Method", "Depth", "Budget", "Changed", "Return", "Runs", "Leaves"]]
    by = ["env", "method", "depth", "budget", "changes", "form"]
    for (env, method, depth, budget, changes, form), group in runs.fillna({"changes": ""}).groupby(by, sort=False):
        returns, is_polished = group["return_mean"], form == "polished"
        spread = f" ± {returns.std():.1f}" if len(group) > 1 else ""
        leaves = group["polish.n_leaves" if is_polished else "pruned_leaves"].mean()
        name = METHODS[method].label + (", polished" if is_polished else "")
        lines.append([env, name, depth, budget, f"`{changes}`" if changes else "", f"{returns.mean():z.1f}{spread}",
                      str(len(group)), f"{leaves:,.0f}"])  # fmt: skip
    table = markdown_table(lines)
    return page("other_environments.md", table=table).rstrip("\n") if len(lines) > 1 else ""


def _variants(every: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for each group of runs that change a setting, with those of the same oracle."""
    lines = [["Task", "Method", "Depth", "Oracle", "Changed", "Ours", "Without the change"]]
    runs = pd.concat([table_runs(every).assign(changes=""), variant_runs(every)])
    runs["oracle"] = runs["oracle.hidden_widths"].fillna("").str.replace(",", ", ")
    by = [*KEY, "oracle", *SOURCE]
    cells = summarise(runs, [*by, "changes"], "return_mean", pruned_depth=("pruned_depth", "mean"))
    is_changed = cells["changes"] != ""
    both = in_order(cells[is_changed], KEY).merge(cells[~is_changed], "left", by, suffixes=("", "_usual"))
    for cell in both.fillna({"n_runs_usual": 0}).astype({"n_runs_usual": int}).itertuples():
        usual_values = {name: getattr(cell, f"{name}_usual") for name in ("mean", "std", "n_runs", "pruned_depth")}
        same = cell._replace(**usual_values)
        values = [f"{_ours(each)} ({runs_text(each)})" if each.n_runs else _ours(each) for each in (cell, same)]
        names = TASK_NAMES.get(cell.task, cell.task), METHOD_NAMES.get(cell.method, cell.method)
        lines.append([*names, cell.depth, cell.oracle, f"`{cell.changes}`", *values])
    return lines
