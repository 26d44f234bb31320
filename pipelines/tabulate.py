"""The thesis's result tables, made from the finished runs: Markdown for people, CSV for programs, LaTeX for papers."""

import difflib
import math
import re
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import ConfigError
from pipelines.published import Published, published, tree_depth
from pipelines.store import corrupt, read_json, write_csv, write_text

SUMMARY_SCHEMA = "otr/summary/1"
CSV_COLUMNS = ("table", "task", "method", "depth", "mean", "std", "ci_low", "ci_high", "n_runs", "n_episodes", "budget",
               "trainer", "published_mean", "published_std", "note")  # fmt: skip
TASKS = {"reacher": "Reacher", "walker2d": "Walker2d", "hopper": "Hopper", "halfcheetah": "HalfCheetah", "ant": "Ant",
         "swimmer": "Swimmer", "bipedalwalker": "BipedalWalker", "pendulum": "Pendulum",
         "mountaincar": "MountainCar", "lunarlander": "LunarLander"}  # fmt: skip
METHODS = {"linear": "Linear", "viper": "VIPER", "lm-viper": "LM-VIPER", "ndps": "NDPS", "pi-prl": "π-PRL",
           "otr": "OTR"}  # fmt: skip
TABLE_TASKS = tuple(TASKS)[:8]  # Table 4.1's rows and columns, in the thesis's order
TABLE_COLUMNS = (("linear", "0"), ("viper", "6"), ("lm-viper", "6"), ("ndps", "6"), ("pi-prl", "6"), ("otr", "6"),
                 ("otr", "32"))  # fmt: skip
TEXT_CELLS = (("mountaincar", "otr", "1"), ("lunarlander", "otr", "2"))  # what chapter 4 reports outside its tables
BUDGET_ORDER = ("thesis", "thesis-fleet", "quick", "quick-fleet")
N_RESAMPLES = 2000
MIN_RUNS_FOR_CI = 3
BOOTSTRAP_SEED = 0


@dataclass(frozen=True)
class Run:
    """What a table needs of one finished run. `budget` is the folder above the seed, `depth` is as in the path."""

    task: str
    method: str
    depth: str
    budget: str
    trainer: str
    seed: int
    algorithm: str
    env_id: str
    steps: int
    return_mean: float
    n_episodes: int
    pruned_depth: float | None
    gymnasium: str


@dataclass(frozen=True)
class Cell:
    """One cell: runs of one task, method, depth, budget and trainer (or none), and the published number, if any."""

    table: str
    task: str
    method: str
    depth: str
    runs: tuple[Run, ...]
    published: Published | None
    notes: tuple[str, ...] = ()

    @property
    def source(self) -> tuple[str, str] | None:
        """The budget and the trainer of the cell's runs; None where nothing was run."""
        return (self.runs[0].budget, self.runs[0].trainer) if self.runs else None

    @property
    def mean(self) -> float:
        """The mean over runs of the runs' mean returns."""
        return statistics.fmean(run.return_mean for run in self.runs)

    @property
    def std(self) -> float | None:
        """The sample standard deviation (n - 1) over runs; None with fewer than two."""
        return statistics.stdev(run.return_mean for run in self.runs) if len(self.runs) > 1 else None

    @property
    def pruned_depth(self) -> float | None:
        """The mean over runs of log2(activation patterns reached); None where a run does not tell."""
        depths = [run.pruned_depth for run in self.runs if run.pruned_depth is not None]
        return statistics.fmean(depths) if depths and len(depths) == len(self.runs) else None


def write_table(table: str, results_dir: Path) -> list[Path]:
    """Write one of the thesis's tables under `results_dir/tables` from the runs under `results_dir/runs`.

    The same runs give the same bytes.

    Args:
        table: its number, such as 4.1.
        results_dir: the folder that holds `runs`; a table of runs that are not there says "not run".

    Returns:
        The Markdown, the CSV and the LaTeX file.

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
    beyond = [make_cell("text", *key, runs) for key in sorted({*runs, *TEXT_CELLS} - shown, key=_beyond_order)]
    cells = [*(cell for row in rows for cell in row), *beyond]

    folder = results_dir / "tables"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"table_4_1.{ending}" for ending in ("md", "csv", "tex")]
    write_text(paths[0], markdown(rows, beyond))
    write_csv(paths[1], [csv_row(cell) for cell in cells], CSV_COLUMNS)
    write_text(paths[2], latex(rows))
    return paths


TABLES: dict[str, Callable[[Path], list[Path]]] = {"4.1": write_table_4_1}


# --- runs ---------------------------------------------------------------------------------------------------------


def read_runs(results_dir: Path) -> dict[tuple[str, str, str], list[Run]]:
    """Return the runs that tables are made of, in order of their paths, under (task, method, depth).

    Left out are smoke budgets, runs with other settings (`seed-<s>~<digest>`) and other versions of a task's
    environment (env=hopper_v5). OTR of depth 0 is the linear policy; where both names hold a seed it counts once.
    """
    found: dict[tuple[str, str, str], dict[tuple[str, str, int], Run]] = defaultdict(dict)
    for path in sorted(results_dir.glob("runs/*/*/depth-*/*/seed-*/summary.json")):
        budget = path.parent.parent.name
        if "~" in path.parent.name or budget.split("-")[0] == "smoke":
            continue
        run = read_run(path)
        if run is not None:
            runs = found[run.task, run.method, run.depth]
            runs.setdefault((run.budget, run.trainer, run.seed), run)
    return {key: list(runs.values()) for key, runs in found.items()}


def read_run(path: Path) -> Run | None:
    """Return one run from its summary; None for another version of the task's environment (env is not the task).

    Raises:
        PipelineError: the file is broken, lacks something or lies in another run's folder.
    """
    summary = read_json(path)
    try:
        if summary["schema"] != SUMMARY_SCHEMA:
            raise ValueError(f"schema {summary['schema']!r} where {SUMMARY_SCHEMA!r} was expected")
        env, method = str(summary["env"]), str(summary["method"])
        depth = _depth_text(summary["depth"])
        place = f"{env}/{method}/depth-{depth}/{path.parent.parent.name}/seed-{summary['seed']}"
        if not path.parent.as_posix().endswith(f"/{place}"):
            raise ValueError(f"it describes the run {place}, not the one whose folder it is in")
        pruned_depth = summary.get("pruned_depth")
        run = Run(
            task=str(summary["task"]),
            method="linear" if (method, depth) == ("otr", "0") else method.replace("_", "-"),
            depth=depth,
            budget=path.parent.parent.name,
            trainer=str(summary["trainer"]),
            seed=int(summary["seed"]),
            algorithm=str(summary["algorithm"]),
            env_id=str(summary["env_id"]),
            steps=int(summary["steps"]),
            return_mean=_finite(summary["return_mean"], "return_mean"),
            n_episodes=int(summary["n_episodes"]),
            pruned_depth=None if pruned_depth is None else _finite(pruned_depth, "pruned_depth"),
            gymnasium=str(summary["versions"]["gymnasium"]),
        )
    except KeyError as error:
        raise corrupt(path, ValueError(f"it has no {error}")) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise corrupt(path, error) from error
    return run if env == run.task else None


def _depth_text(depth: Any) -> str:
    widths = depth if isinstance(depth, list) else [depth]
    return "-".join(str(int(width)) for width in widths if int(width) > 0) or "0"


def _finite(value: Any, name: str) -> float:
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} is {value!r} where a number was expected")
    return float(value)


# --- cells --------------------------------------------------------------------------------------------------------


def make_cell(table: str, task: str, method: str, depth: str, runs: dict[tuple[str, str, str], list[Run]]) -> Cell:
    """Return a cell of the runs of one budget and one trainer, the first there are in `source_order`."""
    sources: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs.get((task, method, depth), []):
        sources[run.budget, run.trainer].append(run)
    order = sorted(sources, key=source_order)
    chosen = tuple(sources[order[0]]) if order else ()
    key = (table, task, method, depth if table == "4.1" else tree_depth(task, method, depth))
    cell = Cell(table, task, method, depth, chosen, published().get(key))
    return replace(cell, notes=(*_notes(cell, key[-1]), *(f"also run: {_runs(sources[other])}" for other in order[1:])))


def source_order(source: tuple[str, str]) -> tuple[int, str, bool, str]:
    """Sort key of (budget, trainer): the thesis's own budget first, then BUDGET_ORDER, then by name; sb3 first."""
    budget, trainer = source
    rank = BUDGET_ORDER.index(budget) if budget in BUDGET_ORDER else len(BUDGET_ORDER)
    return rank, budget, trainer != "sb3", trainer


def bootstrap_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % percentile bootstrap interval of the mean; None with fewer than three values.

    The generator is made anew for each call, so that a cell's interval does not depend on the other cells.
    """
    if len(values) < MIN_RUNS_FOR_CI:
        return None
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    resamples = generator.integers(len(values), size=(N_RESAMPLES, len(values)))
    low, high = np.percentile(np.asarray(values)[resamples].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def best_in_row(row: Sequence[Cell]) -> set[Cell]:
    """Return the row's best cells, ties included; none unless two were run, all under one budget and trainer."""
    ran = [cell for cell in row if cell.runs]
    if len(ran) < 2 or len({cell.source for cell in ran}) > 1:
        return set()
    top = max(cell.mean for cell in ran)
    return {cell for cell in ran if cell.mean == top}


def csv_row(cell: Cell) -> dict[str, Any]:
    """Return a cell under CSV_COLUMNS; what there is not is empty. Six decimals hide how a platform adds up."""
    row: dict[str, Any] = {"table": cell.table, "task": cell.task, "method": cell.method, "depth": cell.depth,
                           "n_runs": len(cell.runs), "note": "; ".join(cell.notes)}  # fmt: skip
    if cell.published is not None:
        row |= {"published_mean": cell.published.mean, "published_std": cell.published.std}
    if not cell.runs:
        return row
    low, high = bootstrap_interval([run.return_mean for run in cell.runs]) or (None, None)
    for name, value in (("mean", cell.mean), ("std", cell.std), ("ci_low", low), ("ci_high", high)):
        row[name] = None if value is None else round(value, 6)
    n_episodes = min(run.n_episodes for run in cell.runs)
    return row | {"n_episodes": n_episodes, "budget": cell.runs[0].budget, "trainer": cell.runs[0].trainer}


def _notes(cell: Cell, thesis_depth: str) -> Iterable[str]:
    """Yield what a reader of the cell should know; `thesis_depth` is how the thesis counts its tree's depth."""
    if not cell.runs:
        yield "not run"
    if cell.published is not None and cell.depth != thesis_depth:
        yield f"published as a tree of depth {thesis_depth}: {cell.depth} hidden neurons and the tests of the actions"
    if cell.pruned_depth is not None and (cell.table == "text" or cell.depth == "32"):
        theirs = cell.published.pruned_depth if cell.published else ""
        yield f"pruned depth {cell.pruned_depth:.1f}" + (f" (published {theirs})" if theirs else "")
    episodes = {run.n_episodes for run in cell.runs}
    if len(episodes) > 1:
        yield f"episodes differ between runs: {min(episodes)} to {max(episodes)}"


def _beyond_order(key: tuple[str, str, str]) -> tuple[int, str, str, list[int]]:
    task, method, depth = key
    rank = list(TASKS).index(task) if task in TASKS else len(TASKS)
    return rank, task, method, [int(width) for width in depth.split("-")]


# --- text ---------------------------------------------------------------------------------------------------------


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
        _markdown_table(lines),
        "\n".join(f"* {note}" for note in _footer(cells)),
        "## Where the numbers come from",
        _markdown_table(_provenance(cells)) if any(cell.runs for cell in cells) else "Nothing has been run yet.",
        "## Beyond the table",
        "What the thesis reports in its text, and runs of other tasks, methods and depths.",
        _markdown_table(others),
    ]
    return "\n\n".join(blocks) + "\n"


def latex(rows: Sequence[Sequence[Cell]]) -> str:
    """Return the table as a `tabular` (it needs booktabs); a task's lines are ours, its runs and the thesis's."""
    cells = [cell for row in rows for cell in row]
    lines = [f"% {note}" for note in (r"\usepackage{booktabs}; wide: use it within \resizebox or on a landscape page.",
                                      *_footer(cells))]  # fmt: skip
    lines += [rf"\begin{{tabular}}{{ll{'r' * len(TABLE_COLUMNS)}}}", r"\toprule"]
    lines.append(_latex_row(["Task", "", *(_tex(_column(*column)) for column in TABLE_COLUMNS)]))
    for row in rows:
        best = best_in_row(row)
        ours = [rf"\textbf{{{_tex(_ours(cell))}}}" if cell in best else _tex(_ours(cell)) for cell in row]
        lines.append(r"\midrule" if row is rows[0] else r"\addlinespace")
        lines.append(_latex_row([_tex(TASKS[row[0].task]), "ours", *ours]))
        if any(cell.runs for cell in row):
            details = [rf"{{\scriptsize {_tex(_runs(cell.runs))}}}" if cell.runs else "" for cell in row]
            lines.append(_latex_row(["", "", *details]))
        lines.append(_latex_row(["", "thesis", *(_tex(_published(cell)) for cell in row)]))
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


def _runs(runs: Sequence[Run]) -> str:
    """Return `3 runs, quick`, with the trainer where it is not the usual one and the budget does not name it."""
    budget, trainer = runs[0].budget, runs[0].trainer
    named = trainer == "sb3" or budget.endswith(f"-{trainer}")
    return f"{len(runs)} run{'s' if len(runs) > 1 else ''}, {budget}" + ("" if named else f", {trainer}")


def _published(cell: Cell) -> str:
    """Return the published number with the digits it was printed with; a dash where there is none."""
    if cell.published is None:
        return "-"
    spread = f" ± {cell.published.std}" if cell.published.std else ""
    pruned = f" [{cell.published.pruned_depth}]" if cell.published.pruned_depth else ""
    return f"{cell.published.mean}{spread}{pruned}"


def _markdown_cell(cell: Cell, bold: bool) -> str:
    text = f"**{_ours(cell)}**" if bold else _ours(cell)
    return f"{text} ({_runs(cell.runs)})" if cell.runs else text


def _markdown_table(lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table of a head and rows, its columns padded so that it reads well as plain text too."""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    padded = [[text.ljust(width) for text, width in zip(line, widths, strict=True)] for line in lines]
    padded.insert(1, ["-" * max(width, 3) for width in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def _latex_row(texts: Iterable[str]) -> str:
    return " & ".join(texts) + r" \\"


def _tex(text: str) -> str:
    """Return plain text as LaTeX: special characters escaped, a minus sign before a number, ± and π as mathematics."""
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    text = re.sub(r"(?<!\w)-(?=\d)", "$-$", text)
    return text.replace("±", r"$\pm$").replace("π", r"$\pi$")
