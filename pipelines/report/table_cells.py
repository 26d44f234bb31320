"""The cells of a table: finished runs grouped by what made them, beside the published numbers."""

import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.engine.store import corrupt, read_json
from pipelines.report.published import FOR_MANY_DEPTHS, OF_ONE_POLICY, Published, published_cell, tree_depth

SUMMARY_SCHEMA = "otr/summary/1"
CSV_COLUMNS = ("table", "task", "method", "depth", "mean", "std", "ci_low", "ci_high", "n_runs", "n_episodes", "budget",
               "trainer", "published_mean", "published_std", "note")  # fmt: skip
TASKS = {"reacher": "Reacher", "walker2d": "Walker2d", "hopper": "Hopper", "halfcheetah": "HalfCheetah", "ant": "Ant",
         "swimmer": "Swimmer", "bipedalwalker": "BipedalWalker", "pendulum": "Pendulum",
         "mountaincar": "MountainCar", "lunarlander": "LunarLander"}  # fmt: skip
METHODS = {"linear": "Linear", "viper": "VIPER", "lm-viper": "LM-VIPER", "ndps": "NDPS", "pi-prl": "π-PRL",
           "otr": "OTR", "augtree": "AugTree", "sdt": "SDT", "sdt-soft": "SDT, soft",
           "sdt-discrete": "SDT, discretised", "cdt": "CDT", "cdt-soft": "CDT, soft",
           "cdt-discrete": "CDT, discretised", "pi-prl-soft": "π-PRL, relaxed",
           "pid": "PID", "pid-constant": "PID, constant gains"}  # fmt: skip
# Forms of a policy beside its tree that a summary may have, each a row beyond the table: the soft tree before it was
# hardened, and what its authors' own discretisation makes of it; a PID policy with its leaves' gains averaged.
FORMS = {"soft": "soft", "discretised": "discrete", "constant_gains": "constant"}
TABLE_TASKS = tuple(TASKS)[:8]  # Table 4.1's rows and columns, in the thesis's order
TABLE_COLUMNS = (("linear", "0"), ("viper", "6"), ("lm-viper", "6"), ("ndps", "6"), ("pi-prl", "6"), ("otr", "6"),
                 ("otr", "32"))  # fmt: skip
TEXT_CELLS = (("mountaincar", "otr", "1"), ("lunarlander", "otr", "2"), ("lunarlander", "sdt-soft", "5"),
              ("lunarlander", "sdt-discrete", "5"), ("lunarlander", "cdt", "3-3"),
              ("lunarlander", "augtree", "2"),
              ("pendulum", "pid", "1"))  # fmt: skip # what chapter 4 reports outside its tables
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
        for run in read_forms(path):
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


def read_forms(path: Path) -> list[Run]:
    """Return one run from its summary, and it once more for each of FORMS, as method `<method>-<form>`.

    Raises:
        PipelineError: as `read_run`.
    """
    run = read_run(path)
    if run is None:
        return []
    runs = [run]
    try:
        for name, form in FORMS.items():
            if (moments := read_json(path).get("policies", {}).get(name)) is not None:
                value = _finite(moments["return_mean"], f"policies.{name}.return_mean")
                n_episodes = int(moments["n_episodes"])
                runs.append(
                    replace(
                        run, method=f"{run.method}-{form}", return_mean=value, n_episodes=n_episodes, pruned_depth=None
                    )
                )
    except KeyError as error:
        raise corrupt(path, ValueError(f"it has no {error}")) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise corrupt(path, error) from error
    return runs


def _depth_text(depth: Any) -> str:
    widths = depth if isinstance(depth, list) else [depth]
    return "-".join(str(int(width)) for width in widths if int(width) > 0) or "0"


def _finite(value: Any, name: str) -> float:
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} is {value!r} where a number was expected")
    return float(value)


def make_cell(table: str, task: str, method: str, depth: str, runs: dict[tuple[str, str, str], list[Run]]) -> Cell:
    """Return a cell of the runs of one budget and one trainer, the first there are in `source_order`."""
    sources: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs.get((task, method, depth), []):
        sources[run.budget, run.trainer].append(run)
    order = sorted(sources, key=source_order)
    chosen = tuple(sources[order[0]]) if order else ()
    key = (table, task, method, depth if table == "4.1" else tree_depth(task, method, depth))
    cell = Cell(table, task, method, depth, chosen, published_cell(*key))
    return replace(
        cell, notes=(*_notes(cell, key[-1]), *(f"also run: {runs_text(sources[other])}" for other in order[1:]))
    )


def other_cells(shown: Cell, runs: dict[tuple[str, str, str], list[Run]]) -> list[Cell]:
    """Return the runs of a cell's task, method and depth that other budgets or trainers made, a cell each."""
    sources: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs.get((shown.task, shown.method, shown.depth), []):
        sources[run.budget, run.trainer].append(run)
    note = "beside the table's cell, by another budget or trainer"
    return [
        replace(shown, table="other", runs=tuple(sources[source]), notes=(note,))
        for source in sorted(sources, key=source_order)
        if source != shown.source
    ]


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
    if cell.published is not None and (cell.task, cell.method) in FOR_MANY_DEPTHS:
        yield "published for depths 4 to 6 as about 100, without saying whether soft or discretised"
    elif cell.published is not None and (cell.task, cell.method) in OF_ONE_POLICY:
        yield f"published: the one policy of Figure {OF_ONE_POLICY[cell.task, cell.method].figure}"
        if len(cell.runs) > 1:
            yield f"the best run: {max(run.return_mean for run in cell.runs):z.1f}"
    elif cell.published is not None and cell.depth != thesis_depth:
        yield f"published as a tree of depth {thesis_depth}: {cell.depth} hidden neurons and the tests of the actions"
    if cell.pruned_depth is not None and (cell.table == "text" or cell.depth == "32"):
        theirs = cell.published.pruned_depth if cell.published else ""
        yield f"pruned depth {cell.pruned_depth:.1f}" + (f" (published {theirs})" if theirs else "")
    episodes = {run.n_episodes for run in cell.runs}
    if len(episodes) > 1:
        yield f"episodes differ between runs: {min(episodes)} to {max(episodes)}"


def beyond_order(key: tuple[str, str, str]) -> tuple[int, str, str, list[int]]:
    """Sort key of (task, method, depth): tasks in the tables' order, depths as numbers."""
    task, method, depth = key
    rank = list(TASKS).index(task) if task in TASKS else len(TASKS)
    return rank, task, method, [int(width) for width in depth.split("-")]


def runs_text(runs: Sequence[Run]) -> str:
    """Return `3 runs, quick`, with the trainer where it is not the usual one and the budget does not name it."""
    budget, trainer = runs[0].budget, runs[0].trainer
    named = trainer == "sb3" or budget.endswith(f"-{trainer}")
    return f"{len(runs)} run{'s' if len(runs) > 1 else ''}, {budget}" + ("" if named else f", {trainer}")
