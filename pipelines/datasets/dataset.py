"""What every data set is once it is read: three parts, each with features and labels."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from pipelines.datasets.columns import Columns, TaskKind
from pipelines.errors import ConfigError

PARTS = ("train", "valid", "test")


@dataclass(frozen=True, eq=False)
class Part:
    """One part of a data set."""

    X: np.ndarray  # features, (n, d), uint8 for fingerprints, float64 of the user's tables and float32 otherwise
    Y: np.ndarray  # labels, (n, n_labels), float64; NaN where a label was not measured
    groups: np.ndarray | None = None  # of molecules the scaffold's number, (n,); None where rows have nothing in common

    def __post_init__(self) -> None:
        if self.X.ndim != 2 or self.Y.ndim != 2 or len(self.X) != len(self.Y):
            raise ValueError(f"X is {self.X.shape} and Y is {self.Y.shape}; (n, d) and (n, n_labels) were expected")
        if self.groups is not None and self.groups.shape != (len(self.X),):
            raise ValueError(f"groups are {self.groups.shape} where ({len(self.X)},) was expected")

    def take(self, rows: np.ndarray) -> "Part":
        """Return the part of these rows alone, in their order."""
        return Part(self.X[rows], self.Y[rows], None if self.groups is None else self.groups[rows])


def pool(parts: Sequence[Part]) -> Part:
    """Return parts as one, one after the other; its rows have groups where all parts have them."""
    groups = [part.groups for part in parts if part.groups is not None]
    return Part(
        np.concatenate([part.X for part in parts]),
        np.concatenate([part.Y for part in parts]),
        np.concatenate(groups) if len(groups) == len(parts) else None,
    )


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
    _: KW_ONLY
    columns: Columns | None = None  # of a table of the user, how its columns became features

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

    def with_parts(self, rows: Mapping[str, np.ndarray], of: Sequence[str] = PARTS) -> "Dataset":
        """Return the data set with parts made of other rows: their positions in the parts `of` one after the other."""
        pooled = pool([self.part(name) for name in of])
        train, valid, test = (pooled.take(rows[name]) for name in PARTS)
        return replace(self, train=train, valid=valid, test=test)

    def folds(self, n_folds: int = 5) -> list["Dataset"]:
        """Return data sets for a cross-validation inside train and valid; the test part is in none of them.

        Groups stay together, and folds have about as many rows; of more than two classes, as many of each. In data set
        k fold k is the part `test`, on which what was fitted is scored; the next fold is `valid`, the others `train`.
        """
        from sklearn.model_selection import GroupKFold, StratifiedKFold

        pooled = pool([self.train, self.valid])
        n_rows = len(pooled.X)
        groups = np.arange(n_rows) if pooled.groups is None else pooled.groups
        classes = pooled.Y[:, 0]
        if pooled.groups is None and self.task == "classification" and np.nanmax(classes) > 1:
            folds = [rows for _, rows in StratifiedKFold(n_folds).split(np.zeros(n_rows), classes)]
        else:
            folds = [rows for _, rows in GroupKFold(n_folds).split(np.zeros(n_rows), groups=groups)]
        made = []
        for k in range(n_folds):
            others = [rows for i, rows in enumerate(folds) if i not in (k, (k + 1) % n_folds)]
            parts = {"train": np.sort(np.concatenate(others)), "valid": folds[(k + 1) % n_folds], "test": folds[k]}
            made.append(self.with_parts(parts, ("train", "valid")))
        return made

    def _column(self, label: int | str) -> int:
        if isinstance(label, str) and label in self.label_names:
            return self.label_names.index(label)
        if isinstance(label, int | np.integer) and 0 <= label < len(self.label_names):
            return int(label)
        raise ConfigError(
            f"{self.name} has no label {label!r}: a number from 0 to {len(self.label_names) - 1}, "
            f"or one of {', '.join(map(repr, self.label_names))}"
        )
