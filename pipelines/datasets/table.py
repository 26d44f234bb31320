"""Tables of the user, CSV or Parquet, as data sets: what a column may be, and what the target asks for."""

import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from pipelines.datasets.columns import Column, Columns, TaskKind
from pipelines.datasets.dataset import Dataset, Part
from pipelines.datasets.table_file import PARQUET, read_table
from pipelines.errors import ConfigError, did_you_mean

SUFFIXES = (".csv", ".tsv", ".txt", ".csv.gz", *PARQUET)
MOST_VALUES = 64  # of a category
LEAST_ROWS = 20  # of which two are for validation and two for the test
DATE = r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}([T ].*)?"


def load_table(
    path: str | Path,
    target: str | None,
    *,
    task: TaskKind | None = None,
    drop: Sequence[str] = (),
    split: int | None = None,
) -> Dataset:
    """Return a file's rows as a data set of one label; how its columns are encoded is in `columns`.

    The task follows from the target: texts, true and false and two values are classes, other numbers a regression. Of
    ten rows eight are for training, one for validation and one for the test, of each class alike. Rows without a target
    are left out.

    Args:
        path: as of `read_table`.
        target: column that is learnt.
        task: classification, regression or counts, where the target's type does not say it.
        drop: columns that are left out.
        split: seed that deals the rows to the parts; None for 0.

    Raises:
        ConfigError: there is no such file, column or class to learn, or a column is neither numbers nor categories.
    """
    frame = read_table(path)
    for name in [*drop, *([] if target is None else [target])]:
        if name not in frame:
            raise ConfigError(f"{path} has no column {name!r}.{did_you_mean(name, list(frame))}")
    if target is None:
        raise ConfigError(f"{path}: which column is to be learnt? Add target=NAME with one of: {', '.join(frame)}")
    frame = frame.drop(columns=[name for name in drop if name != target])
    every, frame = frame.drop(columns=target), frame[frame[target].notna()].reset_index(drop=True)
    if len(frame) < len(every):
        print(f"{path}: {len(every) - len(frame)} of {len(every)} rows have no {target} and are left out", flush=True)
    if len(frame) < LEAST_ROWS:
        raise ConfigError(f"{path} has {len(frame)} rows with a target; give {LEAST_ROWS} at least")
    kind = task or _task_of(frame[target])
    y, classes = _labels(frame[target], kind)
    features = frame.drop(columns=target)
    rows = _parts(y if kind == "classification" else np.zeros(len(y)), split or 0)
    _check(every, features.iloc[rows["train"]], str(path))
    columns = Columns(
        target, kind, classes, tuple(Column.of(name, features[name].iloc[rows["train"]]) for name in features)
    )
    X = columns.encode(features)
    parts = {part: Part(X[of_part], y[of_part, None]) for part, of_part in rows.items()}
    return Dataset(Path(path).name, kind, (target,), columns.feature_names, *parts.values(), columns=columns)


def is_table(value: str) -> bool:
    """Return whether a data set's name is the path of a table."""
    return value.lower().endswith(SUFFIXES)


def _task_of(target: pd.Series) -> TaskKind:
    is_number = pd.api.types.is_numeric_dtype(target) and not pd.api.types.is_bool_dtype(target)
    return "regression" if is_number and target.nunique() > 2 else "classification"


def _labels(target: pd.Series, task: TaskKind) -> tuple[np.ndarray, tuple[str, ...] | None]:
    """Return the labels (n,), numbers or positions of classes, and the names of these where they are no positions."""
    name, n_values = target.name, target.nunique()
    if n_values < 2:
        raise ConfigError(f"target={name}: every row has {target.iloc[0]}, so that there is nothing to learn")
    problem = _problem(target) if n_values > 2 else None
    if problem and (task == "classification" or not pd.api.types.is_numeric_dtype(target)):
        raise ConfigError(f"target={name}: it has {problem}, which no tree learns; choose another column")
    if task != "classification":
        if not pd.api.types.is_numeric_dtype(target):
            raise ConfigError(f"target={name}: task={task} is for numbers, and it has {str(target.iloc[0])!r}")
        y = target.to_numpy(dtype=np.float64)
        if np.isinf(y).any():
            raise ConfigError(f"target={name}: it holds infinity; make it a large number, or missing")
        if task == "counts" and ((y < 0) | (y != np.round(y))).any():
            raise ConfigError(f"target={name}: task=counts is for whole numbers from 0 on; leave it out")
        return y, None
    values, y = np.unique(target.to_numpy(), return_inverse=True)
    if len(values) > MOST_VALUES:
        raise ConfigError(f"target={name}: {len(values)} classes; {MOST_VALUES} at most, or task=regression")
    alone = values[np.bincount(y) < 2]
    if len(alone):
        raise ConfigError(f"target={name}: one row alone is {str(alone[0])!r}; a class needs two, or leave its row out")
    are_positions = [str(value) for value in values] in ([str(i) for i in range(len(values))], ["0.0", "1.0"])
    return y.astype(np.float64), None if are_positions else tuple(str(value) for value in values)


def _check(columns: pd.DataFrame, training: pd.DataFrame, path: str) -> None:
    """Raise ConfigError that names all columns that are neither numbers nor categories, and what to do."""
    if columns.columns.empty:
        raise ConfigError(f"{path} has no column besides the target")
    problems = {name: _problem(columns[name]) for name in columns}
    problems |= {name: "no value in a training row" for name in columns if training[name].isna().all()}
    wrong = {name: problem for name, problem in problems.items() if problem}
    if wrong:
        lines = "\n".join(f"  {name}: {problem}" for name, problem in wrong.items())
        raise ConfigError(
            f"{path} has columns that are neither numbers nor categories\n{lines}\nLeave them out with "
            f"{_dropping(wrong)}, or make them numbers (days since a date, months) or broader categories"
        )


def _dropping(names: Iterable[str]) -> str:
    """Return the override that leaves columns out, quoted where a shell or Hydra would read their names otherwise."""
    names = list(names)
    if all(re.fullmatch(r"[\w.-]+", name) for name in names):
        return f"drop=[{','.join(names)}]"
    listed = ",".join("'" + name.replace("\\", r"\\").replace("'", r"\'") + "'" for name in names)
    override = f"drop=[{listed}]"
    return shlex.quote(override) if re.search(r'["$`\\!]', override) else f'"{override}"'


def _problem(column: pd.Series) -> str | None:
    """Return what a column is that is neither numbers nor a category."""
    values = column.dropna()
    if pd.api.types.is_datetime64_any_dtype(column):
        return f"dates, as {values.iloc[0]}" if len(values) else "dates"
    n_values = values.nunique()
    if pd.api.types.is_numeric_dtype(column):
        is_whole = pd.api.types.is_integer_dtype(column) and n_values == len(column)
        if is_whole and str(column.name).startswith("Unnamed: "):
            return "whole numbers without a name, as of rows"
        is_whole &= len(column) > MOST_VALUES
        return "another whole number in each row, as an id" if is_whole and np.ptp(column) == len(column) - 1 else None
    text = values.astype(str)
    if len(text) and text.str.fullmatch(DATE).all():
        return f"dates, as {text.iloc[0]}"
    if n_values <= MOST_VALUES:
        return None
    if n_values == len(column):
        return f"another text in each row, as an id: {text.iloc[0]}, {text.iloc[1]}"
    return f"{n_values} different texts, as {text.iloc[0]}; a category may have {MOST_VALUES}"


def _parts(classes: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Return the rows of each part: of ten shuffled rows of a class in turn, the fifth and the tenth are held out."""
    order = np.lexsort((np.random.default_rng(seed).random(len(classes)), classes))
    place = np.arange(len(order)) % 10
    chosen = {"train": (place != 4) & (place != 9), "valid": place == 4, "test": place == 9}
    return {part: np.sort(order[of_part]) for part, of_part in chosen.items()}
