"""The classes among labels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.multiclass import check_classification_targets


def check_labels(y: ArrayLike) -> None:
    """Refuse what no classifier can learn.

    Raises:
        TypeError: labels of several kinds, such as text and None, have no order.
        ValueError: numbers that are no classes, or NaN.
    """
    labels: NDArray[Any] = np.asarray(y)
    kinds = sorted({type(label).__name__ for label in labels.ravel()}) if labels.dtype == object else []
    try:
        check_classification_targets(labels)
    except TypeError as error:
        raise TypeError(f"y has labels of several kinds: {', '.join(kinds)}; give all as one kind, as text") from error
