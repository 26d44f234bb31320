"""Stage score: every tree, pruned to what training rows reach, on the three parts, and its size."""

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
from pipelines.supervised.metrics import metric_of, outputs_of, score
from pipelines.supervised.readable_trees import program_of

COLUMNS = ("label", "train", "valid", "test", "whole_train", "whole_valid", "whole_test", "n_train", "n_valid",
           "n_test", "leaves", "depth", "settings", "epoch", "small_weights", "cpu_seconds")  # fmt: skip


def score_trees(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    """Write `scores.csv`, a row a label, `predictions.npz`, the outputs on the test rows, and `report.json`.

    What is scored and counted is the tree pruned to the paths that training rows reach, OTR-hat (`prune_unreached`);
    the scores of the tree before that, which for OTR and LCN are the network's, are `whole_train` and so on. A small
    tree of one label is written as `program.txt`, too.

    `predictions.npz` has a column a label, in the order of the rows of `scores.csv`: `test` and `whole`, the outputs of
    the two trees, logits, shares of class 1, or values; and `labels`, those of the data set. A label that was not
    measured is NaN in all of them. Classes beyond two have no predictions.
    """
    dataset = dataset_of(config)
    metric = metric_of(dataset)
    trees = read_csv(inputs["fit"] / "trees.csv")
    columns = np.full((3, len(dataset.test.Y), len(trees)), np.nan)
    rows: list[dict[str, Any]] = []
    for i, described in enumerate(trees):
        label = described["label"]
        whole = otr.load(inputs["fit"] / described["file"])
        assert isinstance(whole, otr.ObliqueTree | otr.PatternTree)
        tree = otr.prune_unreached(whole, dataset.labelled("train", label)[0])
        row: dict[str, Any] = {"label": label}
        for part in PARTS:
            X, y = dataset.labelled(part, label)
            outputs = [outputs_of(each, X) for each in (tree, whole)]
            for name, values in zip((part, f"whole_{part}"), outputs, strict=True):
                value = score(metric, values, y)
                row[name] = "" if np.isnan(value) else f"{value:.8g}"
            row[f"n_{part}"] = len(y)
            if part == "test" and metric != "accuracy":
                measured = ~np.isnan(dataset.test.Y[:, dataset.label_names.index(label)])
                columns[:, measured, i] = [*outputs, y]
        row |= {"leaves": tree.n_leaves, "depth": tree.depth}
        rows.append(row | {key: described[key] for key in COLUMNS if key in described})
    program = program_of(tree, dataset) if len(trees) == 1 else None
    if program:
        write_text(out / "program.txt", program)
    write_csv(out / "scores.csv", rows, COLUMNS)
    np.savez_compressed(out / "predictions.npz", test=columns[0], whole=columns[1], labels=columns[2])
    write_json(out / "report.json", report(metric, len(dataset.label_names), rows))


def report(metric: str, n_labels: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the means over labels; what was not learned, or has no score in a part, is left out and counted."""
    small_weights = [row["small_weights"] for row in rows]
    names = (*PARTS, *(f"whole_{part}" for part in PARTS))
    scores = {name: [float(row[name]) for row in rows if row[name] != ""] for name in names}
    return {
        "metric": metric,
        "n_labels": n_labels,
        "labels_left_out": {part: n_labels - len(scores[part]) for part in PARTS},
        **{name: float(np.mean(values)) if values else None for name, values in scores.items()},
        "leaves": float(np.mean([row["leaves"] for row in rows])),
        "depth": float(np.mean([row["depth"] for row in rows])),
        "small_weights": float(np.mean([float(text) for text in small_weights])) if all(small_weights) else None,
        "fit_cpu_seconds": float(np.sum([float(row["cpu_seconds"]) for row in rows])),
    }


SCORE = Stage("score", version=2, inputs=("fit",), keyed=FitConfig.settings, run=score_trees)
