"""When two forms of one policy count as doing the same."""

import numpy as np


def answers_agree(
    ours: np.ndarray, theirs: np.ndarray, outputs: np.ndarray, tolerance: float = 1e-6, slack: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return (n,) bool: do two forms of a policy do the same in each state?

    Args:
        ours, theirs: actions (n, a), which agree where every component differs by at most `tolerance` times the larger
            of 1 and its size; or labels (n,), which may differ only where the two best outputs tie, or where the one
            output whose sign decides is 0.
        outputs: (n, o) affine outputs before the head, for the ties.
        tolerance: relative.
        slack: what is allowed beyond that, (n, o) or one number.
    """
    if ours.ndim == 1:
        rivals = outputs if outputs.shape[1] > 1 else np.column_stack((np.zeros(len(outputs)), outputs))
        two_best = np.sort(rivals, axis=1)[:, -2:]
        scale = np.maximum(1.0, np.abs(two_best).max(axis=1))
        tied = two_best[:, -1] - two_best[:, 0] <= tolerance * scale + np.max(slack, axis=-1)
        return np.asarray((ours == theirs) | tied)
    allowed = tolerance * np.maximum(1.0, np.abs(theirs)) + slack
    return np.asarray((np.abs(ours - theirs) <= allowed).all(axis=1))
