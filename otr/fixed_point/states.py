"""States at which a rounded tree is most likely to be far from its network: what a search starts with, no proof."""

from __future__ import annotations

from itertools import product

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.tree import ObliqueTree

_N = 4096  # states of each kind
_MOST_CORNERS = 10  # inputs


def probing_states(tree: ObliqueTree, domain: Domain) -> FloatArray:
    """Return states of a box (n, d): corners, random ones, and random ones brought to the boundaries of tests."""
    rng = np.random.default_rng(0)
    low, high = domain.low, domain.high
    inside = low + (high - low) * rng.random((_N, tree.n_inputs))
    states = [inside, (low + high)[None] / 2]
    if tree.n_inputs <= _MOST_CORNERS:
        states.append(np.array(list(product(*zip(low, high, strict=True)))))
    forms = np.unique(tree.test_forms, axis=0)
    per_test = max(64, _N // max(len(forms), 1))
    for form in forms[:512]:
        way = form[:-1] * (high - low) ** 2
        length = float(form[:-1] @ way)
        if length > 0:
            start = inside[rng.integers(_N, size=per_test)]
            onto = start - np.outer(start @ form[:-1] + form[-1], way) / length
            states += [np.clip(onto * (1 - step) + step * start, low, high) for step in (0.0, 1e-3, -1e-3)]
    return np.concatenate(states)
