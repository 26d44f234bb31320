"""Stage tabulate: tables from the finished runs, as Markdown and CSV, the thesis's as LaTeX, too."""

import difflib
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from pipelines.engine.store import write_csv, write_text
from pipelines.errors import ConfigError
from pipelines.report.certificate_table import write_certificates
from pipelines.report.table_4_2 import write_table_4_2
from pipelines.report.table_cells import (
    CSV_COLUMNS,
    METHODS,
    MIN_RUNS_FOR_CI,
    N_RESAMPLES,
    TABLE_COLUMNS,
    TABLE_TASKS,
    TASKS,
    TEXT_CELLS,
    Cell,
    Run,
    best_in_row,
    beyond_order,
    csv_row,
    make_cell,
    other_cells,
    read_runs,
    runs_text,
    source_order,
)
from pipelines.report.table_text import latex_row, markdown_table, tex


def write_table(table: str, results_dir: Path) -> list[Path]:
    """Write a table under `results_dir/tables` from the runs under `results_dir/runs`.

    The same runs give the same bytes.

    Args:
        table: its number in the thesis, 4.1 or 4.2, or `certificates`.
        results_dir: the folder that holds `runs`; a table of runs that are not there says "not run".

    Returns:
        The Markdown and the CSV file, then the LaTeX file of a table of the thesis.

    Raises:
        ConfigError: there is no such table; lists those there are.
        PipelineError: a run's summary cannot be read; names the file.
    """
    if table not in TABLES:
        close = difflib.get_close_matches(table, TABLES, n=1, cutoff=0.5)
        hint = f" Did you mean table={close[0]}?" if close else ""
        raise ConfigError(f"table={table} is not known.{hint} Known tables: {', '.join(TABLES)}")
    return TABLES[table](results_dir)


def write_table_4_1(results_dir: Path) -> list[Path]:
    """Write Table 4.1, return and standard deviation on the eight control tasks, and the runs beyond it."""
    runs = read_runs(results_dir)
    rows = [[make_cell("4.1", task, *column, runs) for column in TABLE_COLUMNS] for task in TABLE_TASKS]
    shown = {(cell.task, cell.method, cell.depth) for row in rows for cell in row}
    beyond = [make_cell("text", *key, runs) for key in sorted({*runs, *TEXT_CELLS} - shown, key=beyond_order)]
    beyond += [other for row in rows for cell in row for other in other_cells(cell, runs)]
    cells = [*(cell for row in rows for cell in row), *beyond]

    folder = results_dir / "tables"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"table_4_1.{ending}" for ending in ("md", "csv", "tex")]
    write_text(paths[0], markdown(rows, beyond))
    write_csv(paths[1], [csv_row(cell) for cell in cells], CSV_COLUMNS)
    write_text(paths[2], latex(rows))
    return paths


TABLES: dict[str, Callable[[Path], list[Path]]] = {
    "4.1": write_table_4_1,
    "4.2": write_table_4_2,
    "certificates": write_certificates,
}


def markdown(rows: Sequence[Sequence[Cell]], beyond: Sequence[Cell]) -> str:
    """Return the table, the runs beyond it and the footer; each task takes two lines, ours and the thesis's."""
    lines = [["Task", "", *(_column(*column) for column in TABLE_COLUMNS)]]
    for row in rows:
        best = best_in_row(row)
        lines.append([TASKS[row[0].task], "ours", *(_markdown_cell(cell, cell in best) for cell in row)])
        lines.append(["", "thesis", *(_published(cell) for cell in row)])
    others = [["Task", "Method", "Depth", "Ours", "Thesis", "Note"]]
    for cell in beyond:
        name, method = TASKS.get(cell.task, cell.task), METHODS.get(cell.method, cell.method)
        notes = "; ".join(note for note in cell.notes if note != "not run")
        others.append([name, method, cell.depth, _markdown_cell(cell, bold=False), _published(cell), notes])
    cells = [*(cell for row in rows for cell in row), *beyond]
    blocks = [
        "# Table 4.1: return of tree policies on eight control tasks",
        markdown_table(lines),
        "\n".join(f"* {note}" for note in _footer(cells)),
        "## Where the numbers come from",
        markdown_table(_provenance(cells)) if any(cell.runs for cell in cells) else "Nothing has been run yet.",
        "## Beyond the table",
        "What the thesis reports in its text, and runs of other tasks, methods, depths, budgets and trainers.",
        markdown_table(others),
    ]
    return "\n\n".join(blocks) + "\n"


def latex(rows: Sequence[Sequence[Cell]]) -> str:
    """Return the table as a `tabular` (it needs booktabs); a task's lines are ours, its runs and the thesis's."""
    cells = [cell for row in rows for cell in row]
    lines = [f"% {note}" for note in (r"\usepackage{booktabs}; wide: use it within \resizebox or on a landscape page.",
                                      *_footer(cells))]  # fmt: skip
    lines += [rf"\begin{{tabular}}{{ll{'r' * len(TABLE_COLUMNS)}}}", r"\toprule"]
    lines.append(latex_row(["Task", "", *(tex(_column(*column)) for column in TABLE_COLUMNS)]))
    for row in rows:
        best = best_in_row(row)
        ours = [rf"\textbf{{{tex(_ours(cell))}}}" if cell in best else tex(_ours(cell)) for cell in row]
        lines.append(r"\midrule" if row is rows[0] else r"\addlinespace")
        lines.append(latex_row([tex(TASKS[row[0].task]), "ours", *ours]))
        if any(cell.runs for cell in row):
            details = [rf"{{\scriptsize {tex(runs_text(cell.runs))}}}" if cell.runs else "" for cell in row]
            lines.append(latex_row(["", "", *details]))
        lines.append(latex_row(["", "thesis", *(tex(_published(cell)) for cell in row)]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _footer(cells: Sequence[Cell]) -> Iterable[str]:
    """Yield what the numbers are and what they are not, a sentence or two each."""
    yield ("Ours: mean ± standard deviation over runs of a run's mean return, then how many runs under which budget. "
           "A run's mean return is that of its tree over its evaluation episodes.")  # fmt: skip
    yield ("Standard deviation: over runs, with n - 1; none for one run. The thesis, too, gives it across the runs and "
           "does not say whether it divides by n or n - 1.")  # fmt: skip
    yield (f"The CSV file beside this one has 95 % intervals of the mean too: percentile bootstrap over runs, "
           f"{N_RESAMPLES:,} resamples, from {MIN_RUNS_FOR_CI} runs up.")  # fmt: skip
    yield ("Depth is in the column's head. In square brackets: pruned depth, log2 of the number of activation patterns "
           "reached, averaged over runs.")  # fmt: skip
    yield ("Bold: the best of ours in a row, where two or more were run and all under one budget and trainer. A cell "
           "never mixes budgets or trainers; the thesis's budget is taken where it was run.")  # fmt: skip
    yield ("The same evaluation seeds for every method: episode i starts from the same state whichever policy plays. "
           "Runs with other settings than the budget's are not in the table.")  # fmt: skip
    yield ("Thesis: Orfanos 2023, Table 4.1; ten runs (NDPS and π-PRL three), the best policy of each over 100 "
           "episodes. It does not name its environments' versions, which were probably Gym's v2 or v3: compare with "
           "care. It has no linear column.")  # fmt: skip
    if any(cell.runs and cell.method == "pi-prl" for cell in cells):
        yield "Our π-PRL is an adaptation of the published system to these environments."
    yield "Made by: otr-tabulate table=4.1"


def _provenance(cells: Iterable[Cell]) -> list[list[str]]:
    """Return a head and a line for each task, budget and trainer in the cells: what was run, on what, for how long."""
    groups: dict[tuple[str, tuple[str, str]], list[Run]] = defaultdict(list)
    for cell in cells:
        if cell.source is not None:
            groups[cell.task, cell.source].extend(cell.runs)
    lines = [["Task", "Budget", "Trainer", "Steps", "Algorithm", "Episodes", "Environment", "Gymnasium", "Runs"]]
    for (task, (budget, trainer)), runs in sorted(groups.items(), key=_provenance_order):
        steps = [f"{number:,}" for number in sorted({run.steps for run in runs})]
        episodes = [str(number) for number in sorted({run.n_episodes for run in runs})]
        texts = [{run.algorithm.upper() for run in runs}, {run.env_id for run in runs}, {run.gymnasium for run in runs}]
        algorithms, env_ids, versions = (", ".join(sorted(values)) for values in texts)
        lines.append([TASKS.get(task, task), budget, trainer, " or ".join(steps), algorithms, " or ".join(episodes),
                      env_ids, versions, str(len(runs))])  # fmt: skip
    return lines


def _provenance_order(group: tuple[tuple[str, tuple[str, str]], list[Run]]) -> tuple[Any, ...]:
    task, source = group[0]
    return list(TASKS).index(task) if task in TASKS else len(TASKS), task, source_order(source)


def _column(method: str, depth: str) -> str:
    return f"{METHODS[method]} ({depth})"


def _ours(cell: Cell) -> str:
    """Return `mean ± std [pruned depth]`, the brackets at depth 32 only, as in the thesis; or "not run"."""
    if not cell.runs:
        return "not run"
    decimals = 2 if cell.task == "reacher" else 1
    spread = "" if cell.std is None else f" ± {cell.std:.{decimals}f}"
    pruned = f" [{cell.pruned_depth:.1f}]" if cell.depth == "32" and cell.pruned_depth is not None else ""
    return f"{cell.mean:z.{decimals}f}{spread}{pruned}"


def _published(cell: Cell) -> str:
    """Return the published number with the digits it was printed with; a dash where there is none."""
    if cell.published is None:
        return "-"
    spread = f" ± {cell.published.std}" if cell.published.std else ""
    pruned = f" [{cell.published.pruned_depth}]" if cell.published.pruned_depth else ""
    return f"{cell.published.mean}{spread}{pruned}"


def _markdown_cell(cell: Cell, bold: bool) -> str:
    text = f"**{_ours(cell)}**" if bold else _ours(cell)
    return f"{text} ({runs_text(cell.runs)})" if cell.runs else text
