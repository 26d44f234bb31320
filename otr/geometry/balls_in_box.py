"""`largest_balls` of polytopes with few rows in a box of many inputs, whose sides are no rows.

    max t   subject to   s_i (a_i . x + b_i) >= t,   t <= LARGEST_RADIUS,   -1 <= x_j <= 1 unless j is open

Its dual is to make ``sum_i mu_i s_i b_i + sum_j |sum_i mu_i s_i a_ij|`` small over mu >= 0 with a sum of 1: m numbers,
whatever the inputs are. The dual simplex method with bounded variables runs on it, for all problems side by side: its
bases have a place a row, and a step goes past all inputs that it is worth to send to their other limit. Pivots are
chosen for an objective that is tilted a little in every input: tests of later layers are sums of earlier ones, so that
very many bases have the same multipliers, among which the method would wander.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.half_spaces import HalfSpaces
from otr.geometry.simplex import LARGEST_RADIUS

_SMALLEST_PIVOT = 1e-9
_PARALLEL = 1e-9
_TILT = 1e-7  # of the objective, at most, in every input
_FEASIBLE = 1e-11  # what a number at a place may be beyond its limits by


@dataclass(frozen=True)
class BoxBases:
    """The current bases of the simplex method in n problems of m rows each."""

    places: NDArray[np.int32]  # (n, m): an input, d for t, or ~i for the slack of row i
    multipliers: FloatArray  # (n, m), mu

    @classmethod
    def start(cls, n: int) -> BoxBases:
        """Return the bases of problems without rows."""
        return cls(np.zeros((n, 0), dtype=np.int32), np.zeros((n, 0)))

    @property
    def rows(self) -> NDArray[np.int16]:
        """The row (n, m) of each multiplier."""
        return np.broadcast_to(np.arange(self.places.shape[1], dtype=np.int16), self.places.shape)

    def take(self, problems: Any) -> BoxBases:
        """Return the bases of some problems."""
        return BoxBases(self.places[problems], self.multipliers[problems])

    @classmethod
    def concatenate(cls, parts: list[BoxBases]) -> BoxBases:
        """Return the bases of several lists of problems as one; of fewer rows those that are missing are slack."""
        m = max(part.places.shape[1] for part in parts)
        wider = [part.of_rows(m) for part in parts]
        return cls(
            np.concatenate([part.places for part in wider]), np.concatenate([part.multipliers for part in wider])
        )

    def copied(self) -> BoxBases:
        """Return bases that may be written to."""
        return BoxBases(self.places.copy(), self.multipliers.copy())

    def put(self, problems: IntArray, bases: BoxBases) -> None:
        """Write `bases` in the place of some problems'."""
        self.places[problems], self.multipliers[problems] = bases.places, bases.multipliers

    def of_rows(self, m: int) -> BoxBases:
        """Return the bases of the problems with more rows, m."""
        n, own = self.places.shape
        slack = np.broadcast_to(~np.arange(own, m, dtype=np.int32), (n, m - own))
        return BoxBases(
            np.concatenate((self.places, slack), axis=1), np.concatenate((self.multipliers, np.zeros((n, m - own))), 1)
        )


class BoxSimplex:
    """The simplex method on a chunk of problems; `step` takes all on by one pivot."""

    def __init__(self, rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], bases: BoxBases) -> None:
        """Start from bases (n,)."""
        of_group = rows.of(group)
        self.a = rows.a[of_group] * signs[:, :, None]
        self.b = np.where(signs == 0, 2.0 * LARGEST_RADIUS, rows.b[of_group] * signs)  # those without a sign never bind
        self.is_open = rows.is_open
        slack = ~np.arange(signs.shape[1])
        self.places = bases.of_rows(len(slack)).places.astype(np.int64)
        # A row that bound the problem before, and no longer does, was perhaps part of the basis, which is then rebuilt.
        is_slack = (self.places[:, :, None] == slack).any(axis=1)
        self.places[((signs == 0) & ~is_slack).any(axis=1)] = slack
        tilt = np.random.default_rng(0).uniform(0.5, 1.0, len(rows.is_open))
        self.tilt = np.where(self.is_open, 0.0, _TILT * tilt)
        self.at = np.zeros((len(group), len(rows.is_open)))  # the limit at which an input out of the basis is
        self._solve()
        self.at = np.where(self.is_open, 0.0, np.where(self.slopes >= 0, 1.0, -1.0))
        self._solve()

    def take(self, problems: IntArray) -> None:
        """Go on with some of the problems."""
        for name in (
            "a",
            "b",
            "places",
            "at",
            "inverse",
            "multipliers",
            "prices",
            "slopes",
            "states",
            "numbers",
            "bounds",
        ):
            setattr(self, name, getattr(self, name)[problems])

    def bases(self) -> BoxBases:
        """Return the current bases of all problems."""
        return BoxBases(self.places.astype(np.int32), self.multipliers)

    def margins(self) -> FloatArray:
        """Return how far the states are inside of all rows: (n,)."""
        values = np.matmul(self.a, self.states[:, :, None])[:, :, 0] + self.b
        return np.asarray(values.min(axis=1))

    def _solve(self) -> None:
        """Compute everything from the places: the multipliers, what is at the places, states in the box, bounds."""
        n, _, d = self.a.shape
        try:
            self.inverse = np.linalg.inv(self._columns(self.places))
        except np.linalg.LinAlgError:  # of parallel rows one of which has turned: start over
            self.places[np.linalg.slogdet(self._columns(self.places))[0] == 0] = ~np.arange(self.places.shape[1])
            self.inverse = np.linalg.inv(self._columns(self.places))
        is_t = self.places == d
        self.multipliers = -np.where(is_t[:, :, None], self.inverse, 0.0).sum(axis=1)
        slopes = np.matmul(self.multipliers[:, None], self.a)[:, 0]
        is_input = (self.places >= 0) & ~is_t
        costs = np.where(is_input, self.tilt[np.where(is_input, self.places, 0)], is_t)
        self.prices = -np.matmul(costs[:, None], self.inverse)[:, 0]
        self.slopes = np.matmul(self.prices[:, None], self.a)[:, 0] + self.tilt
        each = np.arange(n)[:, None]
        values = self.at.copy()
        values[each, np.where(is_input, self.places, 0)] *= ~is_input
        t = np.where(is_t.any(axis=1), 0.0, LARGEST_RADIUS)
        right = t[:, None] - self.b - np.matmul(self.a, values[:, :, None])[:, :, 0]
        self.numbers = np.matmul(self.inverse, right[:, :, None])[:, :, 0]
        problem, place = np.nonzero(is_input)
        values[problem, self.places[problem, place]] = self.numbers[problem, place]
        self.states = np.where(self.is_open, values, np.clip(values, -1.0, 1.0))
        mu = np.maximum(self.multipliers, 0.0)
        size = np.abs(slopes[:, ~self.is_open]).sum(axis=1)
        left = LARGEST_RADIUS * np.maximum(1.0 - mu.sum(axis=1), 0.0)
        self.bounds = np.einsum("nm,nm->n", mu, self.b) + size + left

    def _columns(self, places: IntArray) -> FloatArray:
        """Return the columns (n, m, k) of what is at places (n, k), in ``a x - t - slack = -b``."""
        _, m, d = self.a.shape
        is_input, is_slack = (places >= 0) & (places < d), places < 0
        columns = np.take_along_axis(self.a, np.where(is_input, places, 0)[:, None, :], axis=2)
        columns = np.where(is_input[:, None, :], columns, -1.0)  # of t
        slack = -(np.arange(m)[:, None] == np.where(is_slack, ~places, -1)[:, None, :]).astype(np.float64)
        return np.where(is_slack[:, None, :], slack, columns)

    def step(self) -> BoolArray:
        """Make one pivot in every problem; return (n,) in which there is none to make."""
        n, m, d = self.a.shape
        each = np.arange(n)
        is_t, is_slack = self.places == d, self.places < 0
        is_free = ~is_slack & ~is_t & self.is_open[np.clip(self.places, 0, d - 1)]
        low = np.where(is_slack, 0.0, np.where(is_t | is_free, -np.inf, -1.0))
        high = np.where(is_slack | is_free, np.inf, 1.0)
        beyond = np.maximum(low - self.numbers, self.numbers - high)
        leaving = beyond.argmax(axis=1)
        excess = beyond[each, leaving]
        up = np.where(self.numbers[each, leaving] < low[each, leaving], 1.0, -1.0)  # which way it has to go
        row = self.inverse[each, leaving]
        # Of all that could enter: inputs, slacks, t. What a step of the dual does to each, and where each turns.
        pace = up[:, None] * np.column_stack((np.matmul(row[:, None], self.a)[:, 0], -row, -row.sum(axis=1)))
        costs = np.column_stack((self.slopes, -self.prices, 1.0 - self.prices.sum(axis=1)))
        limit = np.column_stack((self.at, np.full((n, m), -1.0), np.ones(n)))
        turns = np.where(limit == 0, np.abs(pace), pace * limit) > _SMALLEST_PIVOT
        index = np.where(is_slack, d + ~self.places, np.where(is_t, d + m, self.places))
        turns[each[:, None], index] = False
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(turns, np.maximum(costs / pace, 0.0), np.inf)
        width = np.concatenate((np.where(self.is_open, np.inf, 2.0), np.full(m + 1, np.inf)))
        order = np.argsort(ratio, axis=1, kind="stable")
        in_order = np.take_along_axis(ratio, order, axis=1)
        with np.errstate(invalid="ignore"):
            gains = np.where(np.isfinite(in_order), width[order] * np.abs(np.take_along_axis(pace, order, axis=1)), 0.0)
        stops = (excess[:, None] - np.cumsum(gains, axis=1) <= 0) & np.isfinite(in_order)
        last = stops.argmax(axis=1)
        stuck: BoolArray = ~stops.any(axis=1) | (excess <= _FEASIBLE)
        passed = (np.arange(ratio.shape[1]) < last[:, None]) & ~stuck[:, None]
        flips = np.zeros_like(passed)
        np.put_along_axis(flips, order, passed, axis=1)
        self.at = np.where(flips[:, :d], -self.at, self.at)
        entering = order[each, last]
        entering = np.where(entering < d, entering, np.where(entering < d + m, ~(entering - d), d))
        old = self.places[each, leaving]
        was_input = np.flatnonzero(~stuck & (old >= 0) & (old < d))
        self.at[was_input, old[was_input]] = np.where(self.is_open[old[was_input]], 0.0, -up[was_input])
        go_on = np.flatnonzero(~stuck)
        self.places[go_on, leaving[go_on]] = entering[go_on]
        self._solve()
        return stuck


def highest_in_box(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], multipliers: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the highest value (n,) of sums of rows over the box, and the rounding that may be in it.

    Also the sums' slopes (n, n_open) in the open inputs, over which there is a highest value where these are
    rounding, and that rounding.
    """
    of_group = rows.of(group)
    signed = multipliers * signs
    slopes = np.einsum("nm,nmd->nd", signed, rows.a[of_group])
    errors = np.einsum("nm,nmd->nd", multipliers, rows.rounding[of_group])
    closed = ~rows.is_open
    highest = np.einsum("nm,nm->n", signed, rows.b[of_group]) + np.abs(slopes[:, closed]).sum(axis=1)
    rounding = errors[:, -1] + errors[:, :-1][:, closed].sum(axis=1)
    return highest, rounding, np.abs(slopes[:, rows.is_open]), errors[:, :-1][:, rows.is_open]


def opposite_rows(rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], asked: int) -> FloatArray:
    """Return multipliers (n, m), half and half, of a row and of the one that is its opposite; 0 where there is none."""
    of_group = rows.of(group)
    cosines = np.einsum("nmd,nd->nm", rows.a[of_group], rows.a[of_group, asked]) * signs * signs[:, [asked]]
    opposite, each = cosines.argmin(axis=1), np.arange(len(group))
    multipliers = np.zeros(signs.shape)
    multipliers[each, opposite] = multipliers[:, asked] = np.where(cosines[each, opposite] < -1 + _PARALLEL, 0.5, 0.0)
    return multipliers
