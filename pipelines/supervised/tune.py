"""Stage tune: every combination of the grid is fitted and scored where it was not fitted; the best ones are kept.

That is on the validation part, or on each fold of a cross-validation inside train and valid (`Dataset.folds`). The
test part is not used. What has been tried is kept in `results/checkpoints` until all of it is, so that a killed
job goes on with the next combination.
"""

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from otr.errors import DivergedError
from pipelines.datasets.dataset import Dataset
from pipelines.engine.digests import digest
from pipelines.engine.stage import Stage
from pipelines.engine.store import read_json, write_csv, write_json
from pipelines.engine.time_left import progress_lines
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
    on_folds = config.method.tuned_on == "folds"
    trials = [(each, "test") for each in dataset.folds()] if on_folds else [(dataset, "valid")]
    parts = np.full((len(trials), len(tried), len(labels)), np.nan)
    seconds = np.zeros(len(tried))
    progress = progress_lines(f"{config.line_start}tune", "combinations" if len(trials) == 1 else "fits")
    for k, (data, part) in enumerate(trials):  # fold by fold, as what a teacher answers is kept for one of them
        for i, changes in enumerate(tried):
            path = folder / f"{digest([changes, k])[:16]}.json"
            parts[k, i], took = _scores(config, data, part, labels, changes, path)
            seconds[i] += took
            progress(k * len(tried) + i + 1, len(trials) * len(tried))
    scores = mean_over_trials(parts)
    rows = [
        {
            "label": dataset.label_names[label],
            "settings": json.dumps(changes),
            "valid": f"{value:.6g}",
            "seconds": f"{took / len(labels):.3g}",
        }
        for changes, of_labels, took in zip(tried, scores, seconds, strict=True)
        for label, value in zip(labels, of_labels, strict=True)
    ]
    best = best_of(scores, config.method.tuned_for == "label", metric_of(dataset))
    write_csv(out / "candidates.csv", rows, COLUMNS)
    write_json(
        out / "chosen.json",
        [
            {"label": dataset.label_names[label], "settings": tried[best[i]], "valid": _number(scores[best[i], i])}
            for i, label in enumerate(labels)
        ],
    )


def mean_over_trials(parts: np.ndarray) -> np.ndarray:
    """Return the means (combinations, labels) of scores (trials, combinations, labels), NaN where one is missing.

    Trials without a score for a label, whatever the combination, do not count; a combination that fails one of the
    others has no mean.
    """
    known = ~np.isnan(parts).all(axis=1, keepdims=True)
    n_known = known.sum(axis=0)
    means: np.ndarray = np.where(n_known > 0, np.where(known, parts, 0.0).sum(axis=0) / np.maximum(n_known, 1), np.nan)
    return means


def best_of(scores: np.ndarray, for_label: bool, metric: str) -> list[int]:
    """Return, for every label, the best combination of scores (combinations, labels), the first of equals.

    A label that its validation rows cannot score (NaN) takes what is best for the others on average; so do all of them
    unless `for_label`. A combination without a score where others have one is the worst.
    """
    gains = np.array([[gain(metric, value) for value in row] for row in scores])
    known = ~np.isnan(gains).all(axis=0)
    average = np.nan_to_num(gains[:, known], nan=-np.inf).mean(axis=1) if known.any() else np.zeros(len(gains))
    overall = int(np.argmax(average))
    if not for_label:
        return [overall] * scores.shape[1]
    return [int(np.nanargmax(gains[:, i])) if known[i] else overall for i in range(scores.shape[1])]


def checkpoint_folder(config: FitConfig, inputs: Mapping[str, Path] | None = None) -> Path:
    """Return where the scores of what has been tried are until all of it is; tuning reads no other stage."""
    return Path(config.results_dir) / "checkpoints" / f"tune-{digest([VERSION, tune_settings(config)])[:16]}"


def _scores(
    config: FitConfig, dataset: Dataset, part: str, labels: list[int], changes: dict[str, Any], path: Path
) -> tuple[np.ndarray, float]:
    """Return the scores of one combination on a part, the mean over the tuning seeds for every label, and seconds.

    NaN stands for a label of which the data set's training rows, or the part's, have one class, and for all of them
    where the training diverged.
    """
    if path.exists():
        before = read_json(path)
        return np.array(before["scores"], dtype=np.float64), before["seconds"]
    began, metric = time.process_time(), metric_of(dataset)
    seeds = config.method.tuning_seeds
    progress = progress_lines(f"{config.line_start}tune {json.dumps(changes)}", "trees")
    method = with_settings(config.method, changes)
    learned = [label for label in labels if label in usable_labels(dataset)]
    means = dict.fromkeys(labels, np.nan)
    try:
        fitted = fit_trees(method, dataset, learned, seeds, n_workers=config.n_workers, progress=progress)
    except DivergedError as error:
        print(f"{config.line_start}tune {json.dumps(changes)}: {error}; it is not chosen", flush=True)
        learned, fitted = [], []
    for label, of_label in zip(learned, fitted, strict=True):
        X, y = dataset.labelled(part, label)
        learnt = np.unique(dataset.labelled("train", label)[1])  # a fold may lack a class
        outputs = [
            learnt[each.tree.predict(X)] if metric == "accuracy" else outputs_of(each.tree, X) for each in of_label
        ]
        means[label] = float(np.mean([score(metric, each, y) for each in outputs]))
    seconds = time.process_time() - began
    write_json(path, {"settings": changes, "scores": [_number(mean) for mean in means.values()], "seconds": seconds})
    return np.array(list(means.values())), seconds


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


TUNE = Stage("tune", VERSION, inputs=(), keyed=tune_settings, run=tune, checkpoints=checkpoint_folder)
