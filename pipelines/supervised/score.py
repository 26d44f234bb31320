"""Stage score: every tree on the training, validation and test part, and its size."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import otr
from pipelines.datasets.dataset import PARTS
from pipelines.engine.stage import Stage
from pipelines.engine.store import read_csv, write_csv, write_json, write_text
from pipelines.supervised.config import FitConfig
from pipelines.supervised.learners import dataset_of
from pipelines.supervised.metrics import metric_of, outputs_of, score, size_of
from pipelines.supervised.readable_trees import program_of

COLUMNS = ("label", "train", "valid", "test", "n_train", "n_valid", "n_test", "leaves", "depth", "settings", "epoch",
           "small_weights", "cpu_seconds")  # fmt: skip


def score_trees(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    """Write `scores.csv`, a row a label, `predictions.npz`, the outputs on the test rows, and `report.json`.

    The predictions have a column a label, in the order of the rows of `scores.csv`: logits, shares of class 1, or
    values; NaN where the label was not measured. Classes beyond two have no predictions. A small tree of one label is
    written as `program.txt`, too.
    """
    dataset = dataset_of(config)
    metric = metric_of(dataset)
    trees = read_csv(inputs["fit"] / "trees.csv")
    predictions = np.full((len(dataset.test.Y), len(trees)), np.nan, dtype=np.float32)
    rows: list[dict[str, Any]] = []
    for i, described in enumerate(trees):
        label = described["label"]
        tree = otr.load(inputs["fit"] / described["file"])
        row: dict[str, Any] = {"label": label}
        for part in PARTS:
            X, y = dataset.labelled(part, label)
            outputs = outputs_of(tree, X)
            value = score(metric, outputs, y)
            row |= {part: "" if np.isnan(value) else f"{value:.8g}", f"n_{part}": len(y)}
            if part == "train":
                depth, leaves = size_of(tree, X)
            elif part == "test" and outputs.ndim == 1:
                measured = ~np.isnan(dataset.test.Y[:, dataset.label_names.index(label)])
                predictions[measured, i] = outputs
        row |= {"leaves": leaves, "depth": depth}
        rows.append(row | {key: described[key] for key in COLUMNS if key in described})
    program = program_of(tree, dataset) if len(trees) == 1 else None
    if program:
        write_text(out / "program.txt", program)
    write_csv(out / "scores.csv", rows, COLUMNS)
    np.savez_compressed(out / "predictions.npz", test=predictions)
    write_json(out / "report.json", report(metric, len(dataset.label_names), rows))


def report(metric: str, n_labels: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the means over labels; what was not learned, or has no score in a part, is left out and counted."""
    small_weights = [row["small_weights"] for row in rows]
    scores = {part: [float(row[part]) for row in rows if row[part] != ""] for part in PARTS}
    return {
        "metric": metric,
        "n_labels": n_labels,
        "labels_left_out": {part: n_labels - len(values) for part, values in scores.items()},
        **{part: float(np.mean(values)) if values else None for part, values in scores.items()},
        "leaves": float(np.mean([row["leaves"] for row in rows])),
        "depth": float(np.mean([row["depth"] for row in rows])),
        "small_weights": float(np.mean([float(text) for text in small_weights])) if all(small_weights) else None,
        "fit_cpu_seconds": float(np.sum([float(row["cpu_seconds"]) for row in rows])),
    }


SCORE = Stage("score", version=1, inputs=("fit",), settings=FitConfig.settings, run=score_trees)
