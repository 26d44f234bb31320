"""Stage fit: a tree for every label, those of many seeds together where the learner is a network."""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import otr
from pipelines.datasets.dataset import Dataset
from pipelines.engine.stage import Stage
from pipelines.engine.store import read_json, write_csv
from pipelines.engine.time_left import progress_lines
from pipelines.supervised.config import FitConfig, fit_settings, with_settings
from pipelines.supervised.learners import FittedTree, check_learner, dataset_of, fit_trees, usable_labels
from pipelines.supervised.readable_trees import draw, named

COLUMNS = ("label", "file", "settings", "epoch", "small_weights", "cpu_seconds")


def fit(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    """Write every label's tree as `label-<column>.npz` and `.json`, and `trees.csv` that lists them.

    A small tree of one label is drawn as `tree.png`, too, and the columns of a table are `columns.json`.
    """
    fit_together([inputs], [config], [out])


def fit_together(
    inputs: Sequence[Mapping[str, Path]], configs: Sequence[FitConfig], outs: Sequence[Path]
) -> list[Exception | None]:
    """Do `fit` for seeds of one method, tuned alike, on one data set; an error is raised and concerns them all."""
    first = configs[0]
    dataset = dataset_of(first)
    check_learner(first.method, dataset)
    seeds = [config.seed for config in configs]
    rows: list[list[dict[str, Any]]] = [[] for _ in configs]
    for changes, labels in _by_settings(inputs[0], dataset):
        began = time.process_time()
        fitted = fit_trees(
            with_settings(first.method, changes),
            dataset,
            labels,
            seeds,
            n_workers=first.n_workers,
            progress=progress_lines(f"{first.line_start}fit", "trees"),
        )
        seconds = (time.process_time() - began) / (len(labels) * len(seeds))
        for label, of_label in zip(labels, fitted, strict=True):
            for position, each in enumerate(of_label):
                name = f"label-{label:02d}"
                otr.save(named(each.tree, dataset), outs[position] / name)
                if dataset.columns:
                    dataset.columns.write(outs[position] / "columns.json")
                if len(dataset.label_names) == 1:
                    draw(each.tree, dataset, outs[position] / "tree.png")
                rows[position].append(_row(dataset.label_names[label], name, changes, each, seconds))
    for out, of_seed in zip(outs, rows, strict=True):
        write_csv(out / "trees.csv", sorted(of_seed, key=lambda row: str(row["file"])), COLUMNS)
    return [None] * len(configs)


def _by_settings(inputs: Mapping[str, Path], dataset: Dataset) -> list[tuple[dict[str, Any], list[int]]]:
    """Return the labels that share what was chosen for them, together with it."""
    labels = usable_labels(dataset)
    if "tune" not in inputs:
        return [({}, labels)]
    chosen = [each["settings"] for each in read_json(inputs["tune"] / "chosen.json")]
    groups: dict[str, tuple[dict[str, Any], list[int]]] = {}
    for label, changes in zip(labels, chosen, strict=True):
        groups.setdefault(json.dumps(changes, sort_keys=True), (changes, []))[1].append(label)
    return list(groups.values())


def _row(label: str, file: str, changes: dict[str, Any], fitted: FittedTree, seconds: float) -> dict[str, Any]:
    return {
        "label": label,
        "file": file,
        "settings": json.dumps(changes),
        "epoch": fitted.epoch,
        "small_weights": None if fitted.small_weights is None else round(fitted.small_weights, 6),
        "cpu_seconds": f"{seconds:.3g}",
    }


# It reads stage tune where the method has a grid: `pipelines.supervised.fit_job.stages_of` sets its inputs.
FIT = Stage("fit", version=1, inputs=(), keyed=fit_settings, run=fit, together=fit_together, is_transient=True)
