"""When two forms of one policy count as doing the same."""

import numpy as np


def answers_agree(ours: np.ndarray, theirs: np.ndarray, outputs: np.ndarray, tolerance: float) -> np.ndarray:
    """Return (n,) bool: do two forms of a policy do the same in each state?

    Args:
        ours, theirs: actions (n, a) or labels (n,).
        outputs: (n, o) affine outputs before the head, the scale that rounding is relative to. Labels may differ only
            where the two best outputs tie within `tolerance` of that scale.
        tolerance: relative.
    """
    allowed = tolerance * np.maximum(1.0, np.abs(outputs).max(axis=1))
    if ours.ndim == 1:
        two_best = np.sort(outputs, axis=1)[:, -2:]
        return np.asarray((ours == theirs) | (two_best[:, -1] - two_best[:, 0] <= allowed))
    return np.asarray(np.abs(ours - theirs).max(axis=1) <= allowed)
