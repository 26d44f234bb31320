"""How the columns of a table become features: fitted on training rows, written next to a tree, used on new rows.

A number stays as it is; a missing one becomes the median of the training rows, and where these lack some,
``size is missing`` is a feature of its own. Of a category, each value of the training rows is a feature
``colour == red``, 1 or 0; of two values the first is enough. A missing or new category has none of them.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from pipelines.datasets.table_file import read_table
from pipelines.errors import ConfigError, did_you_mean

TaskKind = Literal["classification", "regression", "counts"]
SCHEMA = "otr/columns/1"


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str
    values: tuple[str, ...] | None  # categories that are features; None of numbers
    fill: float = 0.0  # what a missing number becomes
    has_missing: bool = False  # whether training rows lack some, so that this is a feature

    @classmethod
    def of(cls, name: str, column: pd.Series) -> "Column":
        """Return the column of these training rows."""
        missing = bool(column.isna().any())
        if pd.api.types.is_numeric_dtype(column):
            return cls(name, None, float(np.median(_numbers(name, column.dropna()))), missing)
        values = sorted(column.dropna().astype(str).unique())
        return cls(name, tuple(values[: 1 if len(values) == 2 and not missing else None]), 0.0, missing)

    @property
    def features(self) -> list[str]:
        """The names of its features."""
        named = [self.name] if self.values is None else [f"{self.name} == {value}" for value in self.values]
        return [*named, *([f"{self.name} is missing"] if self.has_missing else [])]

    def encode(self, column: pd.Series) -> np.ndarray:
        """Return its features (n, k) of rows."""
        missing = column.isna().to_numpy(dtype=bool)
        if self.values is None:
            made = [np.where(missing, self.fill, _numbers(self.name, column))]
        else:
            text = column.astype(str).to_numpy()
            is_text = pd.api.types.is_object_dtype(column) or pd.api.types.is_string_dtype(column)
            if not is_text and not np.isin(text[~missing], self.values).all():
                raise ConfigError(
                    f"column {self.name!r} holds texts, as {self.values[0]}, and these rows have numbers, as "
                    f"{column[~missing].iloc[0]}: give the file to encode, or read it with dtype=str"
                )
            made = [(text == value) & ~missing for value in self.values]
        return np.column_stack([*made, *([missing] if self.has_missing else [])]).astype(np.float64)


@dataclass(frozen=True)
class Columns:
    """The columns of a table: from its rows to what a tree reads, and from its answers to classes."""

    target: str
    task: TaskKind
    classes: tuple[str, ...] | None  # what the labels 0, 1, ... are; None where they are themselves, or numbers
    columns: tuple[Column, ...]

    @property
    def feature_names(self) -> tuple[str, ...]:
        """The names of the features, in order."""
        return tuple(name for column in self.columns for name in column.features)

    def encode(self, rows: pd.DataFrame | str | Path) -> np.ndarray:
        """Return the features (n, d) of rows, or of a file's, float64; columns that were not learnt from are ignored.

        Raises:
            ConfigError: a column is missing, has text in place of numbers, or numbers in place of categories.
        """
        if not isinstance(rows, pd.DataFrame):
            rows = read_table(rows, texts=[column.name for column in self.columns if column.values is not None])
        for column in self.columns:
            if column.name not in rows:
                raise ConfigError(f"the rows have no column {column.name!r}.{did_you_mean(column.name, list(rows))}")
        features: np.ndarray = np.concatenate([each.encode(rows[each.name]) for each in self.columns], axis=1)
        return features

    def write(self, path: Path) -> None:
        """Write them as JSON."""
        path.write_text(json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: str | Path) -> "Columns":
        """Return the columns that `write` has written, as a fit does next to its tree."""
        found: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
        columns = tuple(Column(**{**each, "values": _tuple(each["values"])}) for each in found["columns"])
        return cls(found["target"], found["task"], _tuple(found["classes"]), columns)


def _tuple(values: Sequence[str] | None) -> tuple[str, ...] | None:
    return None if values is None else tuple(values)


def _numbers(name: str, column: pd.Series) -> np.ndarray:
    """Return a column (n,) as float64, NaN where it is missing."""
    try:
        numbers: np.ndarray = pd.to_numeric(column).to_numpy(dtype=np.float64, na_value=np.nan)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"column {name!r} holds numbers, and these rows have something else: {error}") from error
    if np.isinf(numbers).any():
        raise ConfigError(f"column {name!r} holds infinity; make it a large number, or missing")
    return numbers
