"""The rows of the aggregated data that one fit sees."""

from __future__ import annotations

import numpy as np

from otr.core.arrays import FloatArray, IntArray


def draw_rows(
    n_rows: int, weights: FloatArray | None, max_samples: int, generator: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Draw rows for a fit: VIPER's resampling where there are weights, else a plain subsample.

    With weights, ``min(n_rows, max_samples)`` rows are drawn with replacement, row i with probability
    ``weights[i] / sum(weights)`` (Bastani et al. 2018, Alg. 1); weights that are all zero count as equal. Without,
    all rows are taken, or `max_samples` of them without replacement.

    Args:
        n_rows: number of rows there are, at least 1.
        weights: (n_rows,), not negative; or None.
        max_samples: number of draws at most.
        generator: of the draws.

    Returns:
        The distinct rows, ascending, (m,), and how often each was drawn, (m,).
    """
    n_draws = min(n_rows, max_samples)
    if weights is None:
        drawn = np.sort(generator.choice(n_rows, n_draws, replace=False, shuffle=False)).astype(np.int64)
        return drawn, np.ones(n_draws, dtype=np.int64)
    total = float(np.sum(weights))
    shares = np.asarray(weights) / total if total > 0 else None
    counts = np.bincount(generator.choice(n_rows, n_draws, p=shares), minlength=n_rows)
    rows = np.flatnonzero(counts)
    return rows, counts[rows]
