"""The nearest state that takes another leaf, or has another label: a search over paths, best first.

Distances are Euclidean, in scales: ``|(s - x) / scales|``. The states of a path are a polytope, and the nearest one is
a least distance problem, solved as non-negative least squares (Lawson and Hanson 1974, ch. 23). A path is at most as
near as what it begins with, so the first end in the order of distances is the nearest.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count

import numpy as np

from otr.clock import check_time
from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.explanation.paths import Paths

CLEAR = 1e-9  # in scales, and of the state's size: by how much a state is clear of every test on its path
_SMALLEST = 1e-13  # residual of the least squares, 1 / (1 + (distance / farthest test)^2): below, nothing is there


def nearest_state(
    paths: Paths, x: FloatArray, wanted: Callable[[FloatArray], bool], scales: FloatArray, domain: Domain
) -> FloatArray | None:
    """Return the nearest wanted state (d,) of a domain that is clear of all tests on its path; None if there is none.

    Args:
        paths: of the tree.
        x: (d,), in the domain.
        wanted: of all states of a path, or of none.
        scales: (d,), above 0.
        domain: of the states.
    """
    clear = CLEAR * (1.0 + float(np.abs(x / scales).max(initial=0.0)))
    number = count()  # so that places at one distance are never compared
    sides = domain.sides()[0]
    box = np.column_stack((sides[:, :-1] * scales, sides[:, :-1] @ x + sides[:, -1]))
    box /= np.abs(box[:, :-1]).sum(axis=1)[:, None]
    still = np.zeros(len(x))
    heap: list[tuple[float, int, tuple[object, ...], FloatArray, FloatArray | None]] = []
    heappush(heap, (0.0, next(number), paths.root, box, still))
    while heap:
        check_time()
        distance, _, place, rows, move = heappop(heap)
        if move is None:
            move = _shortest_move(rows, clear)
            if move is not None:
                heappush(heap, (float(np.linalg.norm(move)), next(number), place, rows, move))
            continue
        form = paths.test(place)
        if form is None:
            state = np.clip(x + move * scales, domain.low, domain.high)
            if wanted(state):
                return state
            continue
        normal, value = form[:-1] * scales, float(form[:-1] @ x + form[-1])
        length = float(np.linalg.norm(normal))
        for right in (False, True):
            sign, child = (1.0 if right else -1.0), paths.child(place, right)
            if length == 0.0:
                if (value > 0) == right:
                    heappush(heap, (distance, next(number), child, rows, move))
                continue
            row = np.append(sign * normal / length, sign * value / length - clear)
            holds = row[:-1] @ move + row[-1] >= 0
            heappush(heap, (distance, next(number), child, np.vstack((rows, row)), move if holds else None))
    return None


def _shortest_move(rows: FloatArray, clear: float) -> FloatArray | None:
    """Return the shortest z (d,) with ``g . z + h >= 0`` for all rows [g | h] (m, d + 1); None if there is none."""
    from scipy.optimize import nnls

    G, h = rows[:, :-1], -rows[:, -1]
    unit = h.max()  # the distance from the farthest test, so that the answer is of size 1 or more
    target = np.append(np.zeros(G.shape[1]), 1.0)
    multipliers, _ = nnls(np.vstack((G.T, h / unit)), target, maxiter=30 * len(rows) + 100)
    if 1.0 - multipliers @ h / unit < _SMALLEST:
        return None
    binding = multipliers > 0
    move: FloatArray = np.linalg.lstsq(G[binding], h[binding], rcond=None)[0]
    return move if (G @ move - h).min() >= -clear / 2 else None
