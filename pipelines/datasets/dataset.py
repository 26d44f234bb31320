"""What every data set is once it is read: three parts, each with features and labels."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipelines.errors import ConfigError

TaskKind = Literal["classification", "regression", "counts"]
PARTS = ("train", "valid", "test")


@dataclass(frozen=True, eq=False)
class Part:
    """One part of a data set."""

    X: np.ndarray  # features, (n, d), uint8 for fingerprints and float32 otherwise
    Y: np.ndarray  # labels, (n, n_labels), float64; NaN where a label was not measured

    def __post_init__(self) -> None:
        if self.X.ndim != 2 or self.Y.ndim != 2 or len(self.X) != len(self.Y):
            raise ValueError(f"X is {self.X.shape} and Y is {self.Y.shape}; (n, d) and (n, n_labels) were expected")


@dataclass(frozen=True, eq=False)
class Dataset:
    """A data set with fixed parts."""

    name: str  # as `load_dataset` takes it
    task: TaskKind  # what its labels are
    label_names: tuple[str, ...]  # one a column of Y
    feature_names: tuple[str, ...]  # one a column of X
    train: Part  # the parts; hyperparameters are chosen on `valid`, `test` is read once
    valid: Part
    test: Part

    def part(self, name: str) -> Part:
        """Return the part called train, valid or test."""
        return {"train": self.train, "valid": self.valid, "test": self.test}[name]

    def labelled(self, part: str, label: int | str = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return features (m, d) and one label (m,) of a part, without the rows where that label is missing.

        The label is a column of Y or its name, int64 for classification, else float64.

        Raises:
            ConfigError: there is no such label.
        """
        column = self._column(label)
        rows = self.part(part)
        y = rows.Y[:, column]
        measured = ~np.isnan(y)
        X = rows.X if measured.all() else rows.X[measured]
        y = y[measured]
        return X, y.astype(np.int64) if self.task == "classification" else y

    def _column(self, label: int | str) -> int:
        if isinstance(label, str) and label in self.label_names:
            return self.label_names.index(label)
        if isinstance(label, int | np.integer) and 0 <= label < len(self.label_names):
            return int(label)
        raise ConfigError(
            f"{self.name} has no label {label!r}: a number from 0 to {len(self.label_names) - 1}, "
            f"or one of {', '.join(map(repr, self.label_names))}"
        )
