"""How much each row of a fit counts: weights of rows and of classes, and moments of weighted rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import _check_sample_weight

from otr.core.arrays import FloatArray

_CONSTANT = 1e-12  # deviation, relative to the largest number of a column, that rounding alone may make

ClassWeight = Mapping[Any, float] | Literal["balanced"] | None


def counted_rows(
    X: NDArray[Any], y: NDArray[Any], sample_weight: ArrayLike | None
) -> tuple[NDArray[Any], NDArray[Any], FloatArray | None]:
    """Return the rows of X (n, d) and y, (n,) or (n, o), whose weight is above 0, and the weights; None for one each.

    Raises:
        ValueError: weights that are negative, all 0, not finite, or not one a row.
    """
    if sample_weight is None:
        return X, y, None
    weights = np.asarray(_check_sample_weight(sample_weight, X, dtype=np.float64, ensure_non_negative=True))
    counts = weights > 0
    if not counts.any():  # of which scikit-learn 1.8 says nothing
        raise ValueError("sample_weight is 0 for all rows, expected at least one non-zero weight")
    return (X, y, weights) if counts.all() else (X[counts], y[counts], weights[counts])


def class_weighted(weights: FloatArray | None, class_weight: ClassWeight, labels: NDArray[Any]) -> FloatArray | None:
    """Return the weights (n,) of rows times those of their classes; None for one each.

    "balanced" gives all classes the same sum: W / (K W_k) for class k, one of K, where W_k is the weight of its rows
    and W that of all (King & Zeng 2001, and scikit-learn's `compute_class_weight`).

    Args:
        weights: (n,) above 0, or None for one each.
        class_weight: "balanced", or weights by class, 1 for those that are not named; None for one each.
        labels: (n,) the classes, as `class_weight` names them.

    Raises:
        ValueError: a class's weight is not above 0 or not finite, or a name is no class of `labels` while a class has
            no weight.
    """
    if class_weight is None:
        return weights
    rows = np.ones(len(labels)) if weights is None else weights
    classes, positions = np.unique(labels, return_inverse=True)
    if class_weight == "balanced":
        sums = np.bincount(positions, weights=rows)
        of_class = sums.sum() / (len(classes) * sums)
    else:
        of_class = _named_weights(class_weight, classes.tolist())
    return np.asarray(rows * of_class[positions])


def _named_weights(class_weight: Mapping[Any, float], classes: list[Any]) -> FloatArray:
    unknown = [name for name in class_weight if name not in classes]
    if unknown and any(name not in class_weight for name in classes):
        raise ValueError(f"class_weight names {unknown[0]!r}, which is no class; the classes are {classes}")
    of_class = np.array([class_weight.get(name, 1.0) for name in classes], dtype=np.float64)
    wrong = np.flatnonzero(~(np.isfinite(of_class) & (of_class > 0)))
    if len(wrong):
        name, weight = classes[wrong[0]], of_class[wrong[0]]
        raise ValueError(f"class_weight of {name!r} is {weight}; give a number above 0, or leave out the class's rows")
    return of_class


def mean_and_deviation(values: FloatArray, weights: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation (d,) of the columns of values (n, d), whose rows may be weighted.

    The deviation of a column that is constant, but for rounding, is 0.
    """
    mean = np.average(values, axis=0, weights=weights)
    deviation = np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weights))
    deviation[deviation <= _CONSTANT * np.abs(values).max(axis=0)] = 0.0
    return mean, deviation


def mean_and_divisor(values: FloatArray, weights: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return what standardises the columns of values (n, d): their means, and their deviations or, of constants, 1."""
    mean, deviation = mean_and_deviation(values, weights)
    return mean, np.where(deviation > 0, deviation, 1.0)
