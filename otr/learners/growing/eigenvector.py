"""The dominant eigenvector of a covariance matrix that is never formed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from otr.core.arrays import FloatArray

# Up to this size of the smaller of the two Gram matrices, n x n or d x d, it is formed and solved exactly.
_MAX_GRAM = 128
# Relative accuracy asked of Lanczos; a product in float32 gives no more.
_TOLERANCE = 1e-5
# A variance below this share of the squared mean is what the mean's rounding leaves of constant data.
_ZERO = 1e-24
_CHUNK_ENTRIES = 2**20


def dominant_direction(
    X: NDArray[Any], random_state: np.random.RandomState, weights: FloatArray | None = None
) -> tuple[float, FloatArray]:
    """Return the largest eigenvalue of the covariance of X (n, d) and its unit eigenvector (d,).

    Lanczos (ARPACK) on ``v -> (X - mean)^T (X - mean) v / n``: O(n d) for each of some tens of products, and O(n + d)
    memory besides X; `random_state` draws the start. Where n or d is small, the smaller Gram matrix is formed instead.
    The largest entry in absolute value is positive, so that the sign is determined. Mean and covariance count a row as
    its weight, `weights` (n,) above 0; None for one each.
    """
    n, d = X.shape
    shares = None if weights is None else weights / weights.sum()
    mean = X.mean(axis=0, dtype=np.float64) if shares is None else _times(shares, X)
    zero = _ZERO * float(mean @ mean)
    if _total_variance(X, mean, shares) <= zero:
        return 0.0, np.eye(1, d)[0]
    if min(n, d) <= _MAX_GRAM:
        value, vector = _by_gram(np.asarray(X - mean, dtype=np.float64), shares)
    else:
        value, vector = _by_lanczos(X, mean, shares, random_state)
    if value <= zero:
        return 0.0, np.eye(1, d)[0]
    vector = vector / np.linalg.norm(vector) * np.sign(vector[np.abs(vector).argmax()])
    return value, vector


def _chunks(X: NDArray[Any]) -> Iterator[slice]:
    chunk = max(1, _CHUNK_ENTRIES // X.shape[1])
    return (slice(start, start + chunk) for start in range(0, len(X), chunk))


def _times(shares: FloatArray, X: NDArray[Any]) -> FloatArray:
    """Return shares @ X in float64 without a float64 copy of all of X."""
    return np.asarray(sum(shares[part] @ X[part].astype(np.float64) for part in _chunks(X)))


def _total_variance(X: NDArray[Any], mean: FloatArray, shares: FloatArray | None) -> float:
    if shares is None:
        return sum(float(np.square(X[part] - mean).sum()) for part in _chunks(X)) / len(X)
    return sum(float((shares[part] @ np.square(X[part] - mean)).sum()) for part in _chunks(X))


def _by_gram(centred: FloatArray, shares: FloatArray | None) -> tuple[float, FloatArray]:
    n, d = centred.shape
    if shares is not None:
        centred = centred * np.sqrt(n * shares)[:, None]
    last = min(n, d) - 1
    gram = centred.T @ centred if d <= n else centred @ centred.T
    values, vectors = eigh(gram, subset_by_index=[last, last])
    vector = vectors[:, 0] if d <= n else vectors[:, 0] @ centred
    return max(float(values[0]), 0.0) / n, vector


def _by_lanczos(
    X: NDArray[Any], mean: FloatArray, shares: FloatArray | None, random_state: np.random.RandomState
) -> tuple[float, FloatArray]:
    n, d = X.shape

    def covariance_times(vector: FloatArray) -> FloatArray:
        vector = vector.ravel()
        image = X @ vector.astype(X.dtype, copy=False)
        image = np.asarray(image, dtype=np.float64) - mean @ vector
        if shares is not None:
            image = image * (n * shares)
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
