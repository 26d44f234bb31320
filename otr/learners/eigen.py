"""The dominant eigenvector of a covariance matrix that is never formed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from otr.arrays import FloatArray

__all__ = ["dominant_direction"]

# Up to this size of the smaller of the two Gram matrices, n x n or d x d, it is formed and solved exactly.
_MAX_GRAM = 128
# Relative accuracy asked of Lanczos; a product in float32 gives no more.
_TOLERANCE = 1e-5


def dominant_direction(X: NDArray[Any], random_state: np.random.RandomState) -> tuple[float, FloatArray]:
    """Return the largest eigenvalue of the covariance of X (n, d) and its unit eigenvector (d,).

    Lanczos (ARPACK) on ``v -> (X - mean)^T (X - mean) v / n``: O(n d) for each of some tens of products, and O(n + d)
    memory beside X. Where n or d is small, the smaller Gram matrix is formed instead. The largest entry in absolute
    value is positive, so that the sign is determined.

    Args:
        X: float64 or float32, n >= 1 rows.
        random_state: draws Lanczos's start.
    """
    n, d = X.shape
    mean = X.mean(axis=0, dtype=np.float64)
    # Squares summed over everything: what an eigenvalue is compared with to call it zero.
    spread = float(np.einsum("ij,ij->", X, X, dtype=np.float64)) / n
    if spread - mean @ mean <= 1e-12 * spread:
        return 0.0, np.eye(1, d)[0]
    if min(n, d) <= _MAX_GRAM:
        value, vector = _by_gram(np.asarray(X - mean, dtype=np.float64))
    else:
        value, vector = _by_lanczos(X, mean, random_state)
    if value <= 1e-12 * spread:
        return 0.0, np.eye(1, d)[0]
    vector = vector / np.linalg.norm(vector) * np.sign(vector[np.abs(vector).argmax()])
    return value, vector


def _by_gram(centred: FloatArray) -> tuple[float, FloatArray]:
    n, d = centred.shape
    last = min(n, d) - 1
    gram = centred.T @ centred if d <= n else centred @ centred.T
    values, vectors = eigh(gram, subset_by_index=[last, last])
    vector = vectors[:, 0] if d <= n else vectors[:, 0] @ centred
    return max(float(values[0]), 0.0) / n, vector


def _by_lanczos(X: NDArray[Any], mean: FloatArray, random_state: np.random.RandomState) -> tuple[float, FloatArray]:
    n, d = X.shape

    def covariance_times(vector: FloatArray) -> FloatArray:
        vector = vector.ravel()
        image = X @ vector.astype(X.dtype, copy=False)
        image = np.asarray(image, dtype=np.float64) - mean @ vector
        back = np.asarray(image.astype(X.dtype, copy=False) @ X, dtype=np.float64)
        return np.asarray((back - image.sum() * mean) / n)

    operator = LinearOperator((d, d), matvec=covariance_times, dtype=np.float64)
    start = np.asarray(random_state.standard_normal(d))
    try:
        values, vectors = eigsh(operator, k=1, which="LA", v0=start, tol=_TOLERANCE)
    except ArpackNoConvergence as error:  # two eigenvalues that agree to all digits: any mixture will do
        if not len(error.eigenvalues):
            return 0.0, start
        values, vectors = error.eigenvalues, error.eigenvectors
    return float(values[0]), vectors[:, 0]
