"""All runs and all fits under a results folder as data frames: tables, figures and certificates are groupings of these.

Besides RUN_COLUMNS and FIT_COLUMNS the frames have the other entries of each summary.json, nested names joined by dots:
`seconds.train` (of the stage), `versions.numpy`, `certify.max_error`, `simplify.n_leaves`.
"""

import math
from collections.abc import Callable, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import pandas as pd

from pipelines.config.run import RunConfig
from pipelines.engine.digests import flat
from pipelines.engine.store import SUMMARY, corrupt, exists, read_json
from pipelines.errors import PipelineError
from pipelines.supervised.config import FitConfig

# Always there, in this order; pages/runs.md and pages/fits.md say what they are. A WHOLE column with a number beyond
# int64, such as the leaves of [64, 64], has Python's integers instead (dtype object).
TEXT, WHOLE, NUMBER = "string", "Int64", "float64"
RUN_COLUMNS = {
    "run": TEXT, "env": TEXT, "task": TEXT, "env_id": TEXT, "method": TEXT, "depth": TEXT, "budget": TEXT,
    "trainer": TEXT, "algorithm": TEXT, "seed": WHOLE, "settings": TEXT, "changes": TEXT, "form": TEXT,
    "return_mean": NUMBER, "return_std": NUMBER, "n_episodes": WHOLE, "steps": WHOLE, "n_leaves": WHOLE,
    "pruned_leaves": WHOLE, "pruned_depth": NUMBER, "patterns": WHOLE, "fidelity": NUMBER, "oracle.hidden_widths": TEXT,
    "versions.gymnasium": TEXT, "certify.certified": "boolean",
}  # fmt: skip
NEEDED = {"task", "env_id", "trainer", "algorithm", "steps", "versions.gymnasium"}  # besides what the folder shows
FIT_COLUMNS = {
    "run": TEXT, "data": TEXT, "split": WHOLE, "method": TEXT, "learner": TEXT, "seed": WHOLE, "settings": TEXT,
    "metric": TEXT,
    "train": NUMBER, "valid": NUMBER, "test": NUMBER, "whole_test": NUMBER, "n_labels": WHOLE, "leaves": NUMBER,
    "depth": NUMBER, "small_weights": NUMBER, "fit_cpu_seconds": NUMBER, "labels_left_out.test": WHOLE,
    "seconds.tune": NUMBER, "teacher.train": NUMBER, "teacher.valid": NUMBER, "teacher.test": NUMBER,
}  # fmt: skip
NOT_OF_EVERY_FIT = {"split", "seconds.tune", "teacher.train", "teacher.valid", "teacher.test"}


def load_runs(results_dir: str | Path) -> pd.DataFrame:
    """Return the finished runs under `results_dir`, a row a run and form of its policy, in order of their folders.

    A folder without summary.json, of an unfinished run or of an oracle's training alone, has no row.

    Raises:
        PipelineError: a summary is broken, lacks something or is in another run's folder; names the file.
    """
    rows: list[dict[str, Any]] = []
    for path in sorted(Path(results_dir).glob("runs/*/*/depth-*/*/seed-*/summary.json")):
        rows += _read(path, RunConfig.summary_schema, _run_rows, NEEDED)
    return _frame(rows, RUN_COLUMNS)


def load_fits(results_dir: str | Path) -> pd.DataFrame:
    """Return the finished fits under `results_dir`, a row each, by data, method, split, seed; raises as `load_runs`."""
    rows: list[dict[str, Any]] = []
    for where in ("seed-*", "split-*/seed-*"):
        for path in sorted(each / SUMMARY for each in Path(results_dir).glob(f"runs/*/*/{where}")):
            if exists(path):
                rows += _read(path, FitConfig.summary_schema, _fit_rows, {*FIT_COLUMNS} - NOT_OF_EVERY_FIT)
    order = sorted(rows, key=lambda row: (row["data"], row["method"], row.get("split", -1), row["seed"]))
    return _frame(order, FIT_COLUMNS)


def _read(
    path: Path, schema: str, rows_of: Callable[[dict[str, Any], Path], list[dict[str, Any]]], needed: Set[str]
) -> list[dict[str, Any]]:
    summary = read_json(path)
    try:
        if summary["schema"] != schema:
            raise ValueError(f"schema {summary['schema']!r} where {schema!r} was expected")
        rows = [_flat(row) for row in rows_of(summary, path.parent)]
        for name in sorted(needed - rows[0].keys()):
            raise KeyError(name)
        return rows
    except KeyError as error:
        raise corrupt(path, ValueError(f"it has no {error}")) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise corrupt(path, error) from error


def _run_rows(summary: dict[str, Any], run_dir: Path) -> list[dict[str, Any]]:
    """Return a row for each form of a run's policy."""
    widths = summary["depth"] if isinstance(summary["depth"], list) else [summary["depth"]]
    depth = "-".join(str(int(width)) for width in widths if int(width) > 0) or "0"
    budget = run_dir.parent.name
    where = _place(run_dir, f"{summary['env']}/{summary['method']}/depth-{depth}/{budget}", summary["seed"])
    own = summary | where | {"depth": depth, "budget": budget}
    if own.get("pruned_depth") is not None:
        _finite(own["pruned_depth"], "pruned_depth")
    forms = own.pop("policies", {}) | {"tree": summary}
    if "oracle" in own and "oracle" not in forms:
        raise KeyError("policies.oracle")
    if "polish" in own:
        forms["polished"] = own["polish"]
    if "simplify" in own:
        forms["simplified"] = own["simplify"]
    return [
        own
        | {
            "form": form,
            "return_mean": _finite(moments["return_mean"], f"{'' if form == 'tree' else f'{form}: '}return_mean"),
            "return_std": moments.get("return_std"),
            "n_episodes": int(moments["n_episodes"]),
        }
        for form, moments in forms.items()
    ]


def _fit_rows(summary: dict[str, Any], run_dir: Path) -> list[dict[str, Any]]:
    split = f"/split-{summary['split']}" if "split" in summary else ""
    where = _place(run_dir, f"{summary['data']}/{summary['method']}{split}", summary["seed"])
    for name in ("train", "valid", "test"):
        if summary[name] is not None:
            _finite(summary[name], name)
    return [summary | where]


def _place(run_dir: Path, above: str, seed: int) -> dict[str, str]:
    """Return a run's folder below runs and the digest of its settings; another run's folder is an error."""
    run = "/".join(run_dir.parts[-above.count("/") - 2 :])
    described, _, settings = run.partition("~")
    if described != f"{above}/seed-{seed}":
        raise PipelineError(
            f"{run_dir}/summary.json describes the run {above}/seed-{seed}, not the one whose folder it is in: move "
            "what is a copy out of the results, or delete a summary that was put there and do the run again"
        )
    return {"run": run, "settings": settings}


def _finite(value: Any, name: str) -> float:
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} is {value!r} where a number was expected")
    return float(value)


def _flat(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested entries under names joined by dots, lists as text: `oracle.hidden_widths` [64,64]."""
    return {n: str(each).replace(" ", "") if isinstance(each, list) else each for n, each in flat(summary).items()}


def _frame(rows: Sequence[Mapping[str, Any]], types: Mapping[str, str]) -> pd.DataFrame:
    """Return rows under the columns of `types` and whatever else they have, that as its values' types say."""
    further = sorted({name for row in rows for name in row} - types.keys() - {"schema"})
    values = {name: [row.get(name) for row in rows] for name in (*types, *further)}
    return pd.DataFrame({name: _column(column, types.get(name)) for name, column in values.items()})


def _column(values: list[Any], dtype: str | None) -> Any:
    try:
        return pd.array(values, dtype=dtype)
    except OverflowError:  # leaves are counted beyond int64: of [64, 64] there are 2**128
        return pd.array(values, dtype="object")
