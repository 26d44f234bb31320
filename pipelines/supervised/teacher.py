"""Stage teacher: the score of the forest itself, no tree, whose probabilities a fit's networks learn."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.datasets.dataset import PARTS, Dataset
from pipelines.engine.stage import Stage
from pipelines.engine.store import read_json, write_csv, write_json
from pipelines.supervised.config import FitConfig, fit_settings
from pipelines.supervised.learners import BATCHED, dataset_of, teacher_of, usable_labels
from pipelines.supervised.metrics import metric_of, score

COLUMNS = ("label", *PARTS)


def score_teacher(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    """Write `scores.csv`, a row a label, and `report.json`, the means over labels; these are empty without a teacher.

    The teacher is the one of the fit's seed, on the same rows, as the learner standardises them. Its settings are those
    that tuning chose.
    """
    from otr.learners.distillation import fit_teacher

    dataset = dataset_of(config)
    labels = usable_labels(dataset)
    chosen = read_json(inputs["tune"] / "chosen.json") if "tune" in inputs else [{"settings": {}}]
    settings = chosen[0]["settings"].get("teacher", getattr(config.method, "teacher", None))
    rows: list[dict[str, Any]] = []
    if settings is not None:
        seen = _standardising(dataset) if config.method.learner in BATCHED else _as_it_is
        fitted = fit_teacher(seen(dataset.train.X), dataset.train.Y[:, labels], teacher_of(settings), seed=config.seed)
        for i, label in enumerate(labels):
            row: dict[str, Any] = {"label": dataset.label_names[label]}
            for part in PARTS:
                X, y = dataset.labelled(part, label)
                row[part] = score(metric_of(dataset), fitted.predict_proba(seen(X))[:, i], y)
            rows.append(row)
    kept = {part: [row[part] for row in rows if not np.isnan(row[part])] for part in PARTS}
    write_csv(out / "scores.csv", rows, COLUMNS)
    write_json(out / "report.json", {part: float(np.mean(values)) if values else None for part, values in kept.items()})


def _standardising(dataset: Dataset) -> Callable[[np.ndarray], np.ndarray]:
    """Return how networks see inputs: shifted and scaled, but for inputs that are all 0 and 1."""
    from otr.learners.base.problem import Problem

    X = dataset.train.X
    if ((X == 0) | (X == 1)).all():
        return _as_it_is
    problem = Problem(X.astype(np.float64), dataset.train.Y, "logistic")
    problem.standardise_inputs()
    return lambda rows: np.asarray((rows - problem.mean) / problem.scale)


def _as_it_is(X: np.ndarray) -> np.ndarray:
    return X


# It reads stage tune where the method has a grid, as stage fit does.
TEACHER = Stage("teacher", version=1, inputs=(), keyed=fit_settings, run=score_teacher)
