"""Stage tune: every combination of the grid is fitted and scored on the validation part; the best ones are kept.

The test part is not looked at. What has been tried lies in `results/checkpoints` until all of it is, so that a killed
job goes on with the next combination.
"""

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.datasets.dataset import Dataset
from pipelines.engine.console import progress_lines
from pipelines.engine.digests import digest
from pipelines.engine.stage import Stage
from pipelines.engine.store import read_json, write_csv, write_json
from pipelines.supervised.config import FitConfig, combinations, tune_settings, with_settings
from pipelines.supervised.learners import check_learner, dataset_of, fit_trees, usable_labels
from pipelines.supervised.metrics import gain, metric_of, outputs_of, score

COLUMNS = ("label", "settings", "valid", "seconds")
VERSION = 1


def tune(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    """Write `candidates.csv`, a row for every label and combination, and `chosen.json`, the best for every label."""
    dataset = dataset_of(config)
    check_learner(config.method, dataset)
    labels, tried = usable_labels(dataset), combinations(config.method)
    folder = checkpoint_folder(config)
    folder.mkdir(parents=True, exist_ok=True)
    scores = np.full((len(tried), len(labels)), np.nan)
    rows: list[dict[str, Any]] = []
    progress = progress_lines(f"{config.line_start}tune", "combinations")
    for i, changes in enumerate(tried):
        scores[i], seconds = _scores(config, dataset, labels, changes, folder / f"{digest(changes)[:16]}.json")
        rows += [
            {
                "label": dataset.label_names[label],
                "settings": json.dumps(changes),
                "valid": f"{value:.6g}",
                "seconds": f"{seconds / len(labels):.3g}",
            }
            for label, value in zip(labels, scores[i], strict=True)
        ]
        progress(i + 1, len(tried))
    best = best_of(scores, config.method.tuned_for == "label", metric_of(dataset))
    write_csv(out / "candidates.csv", rows, COLUMNS)
    write_json(
        out / "chosen.json",
        [
            {"label": dataset.label_names[label], "settings": tried[best[i]], "valid": _number(scores[best[i], i])}
            for i, label in enumerate(labels)
        ],
    )


def best_of(scores: np.ndarray, for_label: bool, metric: str) -> list[int]:
    """Return, for every label, the best combination of scores (combinations, labels), the first of equals.

    A label whose validation rows do not tell (NaN) takes what is best for the others on average; so do all of them
    unless `for_label`.
    """
    gains = np.array([[gain(metric, value) for value in row] for row in scores])
    told = ~np.isnan(gains).all(axis=0)
    average = np.nanmean(gains[:, told], axis=1) if told.any() else np.zeros(len(gains))
    overall = int(np.argmax(average))
    if not for_label:
        return [overall] * scores.shape[1]
    return [int(np.nanargmax(gains[:, i])) if told[i] else overall for i in range(scores.shape[1])]


def checkpoint_folder(config: FitConfig, inputs: Mapping[str, Path] | None = None) -> Path:
    """Return where the scores of what has been tried lie until all of it is; tuning reads no other stage."""
    return Path(config.results_dir) / "checkpoints" / f"tune-{digest([VERSION, tune_settings(config)])[:16]}"


def _scores(
    config: FitConfig, dataset: Dataset, labels: list[int], changes: dict[str, Any], path: Path
) -> tuple[np.ndarray, float]:
    """Return the validation scores of one combination, the mean over the tuning seeds for every label, and seconds."""
    if path.exists():
        before = read_json(path)
        return np.array(before["scores"], dtype=np.float64), before["seconds"]
    began, metric = time.process_time(), metric_of(dataset)
    seeds = config.method.tuning_seeds
    progress = progress_lines(f"{config.line_start}tune {json.dumps(changes)}", "trees")
    method = with_settings(config.method, changes)
    fitted = fit_trees(method, dataset, labels, seeds, n_workers=config.n_workers, progress=progress)
    means = []
    for label, of_label in zip(labels, fitted, strict=True):
        X, y = dataset.labelled("valid", label)
        means.append(float(np.mean([score(metric, outputs_of(each.tree, X), y) for each in of_label])))
    seconds = time.process_time() - began
    write_json(path, {"settings": changes, "scores": [_number(mean) for mean in means], "seconds": seconds})
    return np.array(means), seconds


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


TUNE = Stage("tune", VERSION, inputs=(), settings=tune_settings, run=tune, checkpoints=checkpoint_folder)
