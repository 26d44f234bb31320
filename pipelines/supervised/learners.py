"""From a method's settings to trees: which estimators a learner is, and how labels and seeds are fitted."""

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.datasets.dataset import Dataset
from pipelines.datasets.load import load_dataset
from pipelines.datasets.table import load_table
from pipelines.errors import ConfigError
from pipelines.supervised.config import (
    TABLE,
    FitConfig,
    LearnerConfig,
    OtrConfig,
    combinations,
    learner_settings,
    with_settings,
)

if TYPE_CHECKING:
    from otr import ObliqueTree, PatternTree

SMALL_WEIGHT = 1e-5
ESTIMATORS: dict[str, tuple[str | None, str | None]] = {  # learner: its classifier and its regressor in otr.learners
    "linear": ("LinearTreeClassifier", "LinearTreeRegressor"),
    "cart": ("CARTClassifier", "CARTRegressor"),
    "hhcart": ("HHCARTClassifier", "HHCARTRegressor"),
    "tao": ("TAOClassifier", None),
    "augtree": ("AugTreeClassifier", "AugTreeRegressor"),
    "lcn": ("LCNClassifier", "LCNRegressor"),
    "otr": ("OTRClassifier", "OTRRegressor"),
}
BATCHED = ("lcn", "otr")  # labels and seeds train as one model
EXPLAINED = ("teacher", "class_weight", "loss")  # settings that `_check_settings` refuses with their own messages


@dataclass(frozen=True)
class FittedTree:
    """One label's tree."""

    tree: "ObliqueTree | PatternTree"  # the tree
    epoch: int | None = None  # of the network that was kept; None for learners without
    small_weights: float | None = None  # share of the network's weights below 1e-5 in size; None for learners without


def dataset_of(config: FitConfig) -> Dataset:
    """Return the fit's data set, read once a process; errors as those of `load_dataset` and `load_table`."""
    return _loaded(json.dumps([config.settings()["data"], config.data.file]))


@functools.lru_cache(maxsize=1)
def _loaded(key: str) -> Dataset:
    data, file = json.loads(key)
    if file is None and data["name"] == TABLE:
        raise ConfigError("data=table: of which file? Give data=FILE.csv target=COLUMN")
    if file is None:
        return load_dataset(data["name"], data.get("split"))
    table = {name: data[name] for name in ("task", "drop", "split") if name in data}
    return load_table(file, data.get("target"), **table)


def check_learner(method: LearnerConfig, dataset: Dataset) -> None:
    """Raise ConfigError where the learner has no estimator, or lacks a setting, for the data set's task.

    That is checked for each combination of its grid. A setting that the estimator lacks may have its usual value.
    """
    name = _estimator_name(method.learner, dataset)
    known = {"teacher", "keep", *_parameters_of(name)}
    if method.learner == "augtree":
        known |= {"hidden", "class_weight"}  # of the network
    for key in dict.fromkeys(key for values in method.grid for key in values):
        if key not in known:
            raise ConfigError(f"method.grid: {name}, which {dataset.name} takes, has no {key}; leave it out")
    usual = learner_settings(type(method)(method.name, method.learner))
    for key, value in learner_settings(method).items():
        if key not in known and value != usual[key] and key not in EXPLAINED:
            raise ConfigError(f"method.{key}={value}: {name}, which {dataset.name} takes, has no {key}; leave it out")
    for changes in combinations(method) or [{}]:
        _check_settings(learner_settings(with_settings(method, changes)), dataset)


def _check_settings(settings: dict[str, Any], dataset: Dataset) -> None:
    teacher = settings.get("teacher")
    if not isinstance(teacher, dict | None):
        raise ConfigError(f"method.teacher={teacher}: give values by name, as {{forest: random_forest}}, or null")
    if teacher is not None and dataset.task != "classification":
        raise ConfigError(f"method.teacher is for binary labels, and {dataset.name} is a {dataset.task}; leave it out")
    if dataset.task == "classification" and np.nanmax(dataset.train.Y) > 1:
        for setting in ("teacher", "shared"):  # of labels that are 0 or 1
            if settings.get(setting):
                raise ConfigError(
                    f"method.{setting} is for binary labels, and {dataset.name} has more than two classes"
                )
    if teacher is not None and settings.get("class_weight"):
        raise ConfigError("method.teacher: its rows have weights of their own; leave out the teacher, or class_weight")
    if dataset.task != "classification" and settings.get("class_weight"):
        raise ConfigError(f"method.class_weight is for classes, and {dataset.name} has numbers; leave it out")
    if dataset.task != "counts" and settings.get("loss") == "poisson":
        raise ConfigError(
            f"method.loss=poisson is for counts, and {dataset.name} is a {dataset.task}; take another method, or "
            "method.loss=squared_error"
        )


def usable_labels(dataset: Dataset) -> list[int]:
    """Return the labels that can be learned: all of numbers, those with two classes or more in training."""
    labels = range(len(dataset.label_names))
    if dataset.task != "classification":
        return list(labels)
    return [label for label in labels if len(np.unique(dataset.labelled("train", label)[1])) > 1]


def fit_trees(
    method: LearnerConfig,
    dataset: Dataset,
    labels: Sequence[int],
    seeds: Sequence[int],
    *,
    n_workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[list[FittedTree]]:
    """Fit a tree for every label (column of Y) and seed, by the training and the validation part.

    Args:
        method: settings; its grid is ignored.
        dataset, labels, seeds: what to fit.
        n_workers: threads of learners that have them.
        progress: called with the number of trees done and of all.

    Returns:
        [label][seed], in the order of the arguments.
    """
    name = _estimator_name(method.learner, dataset)
    if method.learner in BATCHED:
        return _fit_together(name, learner_settings(method), dataset, labels, seeds)
    oracles: list[list[Any]] = [[None] * len(seeds) for _ in labels]
    if method.learner == "augtree":
        otr_name = _estimator_name("otr", dataset)
        mine = learner_settings(method)
        otr = learner_settings(OtrConfig("otr", "otr", hidden=mine["hidden"], class_weight=mine["class_weight"]))
        networks = [est.networks_ for est in _estimators(otr_name, otr, dataset, labels, seeds)]
        oracles = [[of_seed[i] for of_seed in networks] for i in range(len(labels))]
    settings = learner_settings(method)
    teacher = settings.pop("teacher", None)
    parameters = _parameters(name, {**settings, "n_jobs": n_workers})
    trees = []
    for i, label in enumerate(labels):
        of_label = []
        for j, seed in enumerate(seeds):
            rows = _labelled(dataset, label) if teacher is None else _taught(dataset, label, json.dumps(teacher), seed)
            estimator = _new(name, parameters, seed, oracles[i][j])
            of_label.append(FittedTree(estimator.fit(*rows).tree_))
            progress(i * len(seeds) + j + 1, len(labels) * len(seeds))
            if teacher is None and "random_state" not in estimator.get_params():  # the same for all seeds
                of_label += of_label * (len(seeds) - 1)
                break
        trees.append(of_label)
    return trees


@functools.lru_cache(maxsize=1)
def _labelled(dataset: Dataset, label: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the training rows that have a label, and the label."""
    X, y = dataset.labelled("train", label)
    return X if X.dtype.kind == "f" else X.astype(np.float32), y  # binary features lose nothing


def _taught(dataset: Dataset, label: int, teacher: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a teacher's rows for a label: each as class 1 and as class 0, weighted by these probabilities."""
    rows, targets = _distilled(dataset, teacher, seed)
    p = targets[:, usable_labels(dataset).index(label)]
    is_one, is_zero = p > 0, p < 1
    X = np.concatenate([rows[is_one], rows[is_zero]])
    y = np.repeat([1.0, 0.0], [is_one.sum(), is_zero.sum()])
    return X, y, np.concatenate([p[is_one], 1 - p[is_zero]])


@functools.lru_cache(maxsize=1)
def _distilled(dataset: Dataset, teacher: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and probabilities, of all labels that can be learned, as networks are taught by them."""
    from otr.learners.distillation import distillation_set

    labels = dataset.train.Y[:, usable_labels(dataset)]
    rows, targets = distillation_set(dataset.train.X, labels, teacher_of(json.loads(teacher)), seed=seed)
    return rows if rows.dtype.kind == "f" else rows.astype(np.float32), targets  # binary features lose nothing


def _fit_together(
    name: str, settings: dict[str, Any], dataset: Dataset, labels: Sequence[int], seeds: Sequence[int]
) -> list[list[FittedTree]]:
    estimators = _estimators(name, settings, dataset, labels, seeds)
    return [
        [
            FittedTree(
                est.trees_[i], int(est.best_epochs_[i]), _small_weights(getattr(est.networks_[i], "weights", []))
            )
            for est in estimators
        ]
        for i in range(len(labels))
    ]


def _estimators(
    name: str, settings: dict[str, Any], dataset: Dataset, labels: Sequence[int], seeds: Sequence[int]
) -> list[Any]:
    """Return an estimator of all labels for every seed, trained as one batched model."""
    if len(labels) == 1:
        (X, y), valid = dataset.labelled("train", labels[0]), dataset.labelled("valid", labels[0])
    else:
        columns = list(labels)
        X, y = dataset.train.X, dataset.train.Y[:, columns]
        valid = (dataset.valid.X, dataset.valid.Y[:, columns])
    estimator = _new(name, _parameters(name, settings), None, None)
    chooses = settings.get("keep", "best") == "best"
    fitted: list[Any] = estimator.fit_seeds(X, y, seeds, validation=valid if chooses else None)
    return fitted


def _new(name: str, parameters: dict[str, Any], seed: int | None, network: Any) -> Any:
    from otr import learners

    estimator = getattr(learners, name)(**parameters)
    known = estimator.get_params()
    if "random_state" in known and seed is not None:
        estimator.set_params(random_state=seed)
    if network is not None:
        estimator.set_params(network=network)
    return estimator


def _parameters(name: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that the estimator has, as it has them."""
    known = _parameters_of(name)
    parameters = {key: value for key, value in settings.items() if key in known}
    if parameters.get("dense") == "none":
        parameters["dense"] = False
    if parameters.get("teacher") is not None:
        parameters["teacher"] = teacher_of(parameters["teacher"])
    return parameters


def _parameters_of(name: str) -> list[str]:
    from otr import learners

    return list(getattr(learners, name)().get_params())


def teacher_of(settings: dict[str, Any]) -> Any:
    """Return the teacher of these settings; raise ConfigError where it has no such."""
    from otr.learners.distillation import Teacher

    try:
        return Teacher(**settings)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"method.teacher: {error}") from error


def _estimator_name(learner: str, dataset: Dataset) -> str:
    name = ESTIMATORS[learner][dataset.task != "classification"]
    if name is None:
        raise ConfigError(f"{learner} is not for {dataset.task}, which {dataset.name} is; choose another method")
    return name


def _small_weights(weights: Sequence[np.ndarray]) -> float | None:
    if not weights:
        return None
    return float(np.mean(np.concatenate([np.abs(weight).ravel() for weight in weights]) < SMALL_WEIGHT))
