"""The regions of a network: every activation pattern that some states have, found by walking the tree of its tests.

All regions of a level are taken on together. Each knows an inner point, which tells one side of the next test that is
not empty; whether the other side is, too, is asked of `largest_balls`. Each level's tests are written in the inputs, by
layer: within a region of the layers before, a layer is an arrangement of hyperplanes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from otr.arrays import BoolArray, FloatArray, IntArray
from otr.domain import Domain
from otr.errors import TreeTooLargeError
from otr.linear_programs import Bases, Rows, largest_balls
from otr.network import ReluNetwork

__all__ = ["Regions", "find_regions"]

_BLOCK = 2**13  # regions walked together; more are set aside, so that memory does not grow with their number
_CLEAR_SHARE = 0.05  # of its margin to other tests: an inner point so far from a new one is inner to its side


@dataclass(frozen=True)
class Regions:
    """Regions of a network, in no particular order.

    Attributes:
        patterns: (k, n_bits) bool, each region's activation pattern and the outcomes of the head's tests.
        inner_points: (k, d), a state inside each.
        n_linear_programs: solved to find them.
        n_tests: pairs of a region and a test that were looked at.
    """

    patterns: BoolArray
    inner_points: FloatArray
    n_linear_programs: int
    n_tests: int


@dataclass
class _Block:
    """Regions walked together, all up to the same test.

    Attributes:
        outcomes: (n, n_done) bool.
        signs: (n, n_rows) int8 of the rows in their group; 0 where a row does not bound the region.
        group: (n,) int64.
        rows: the box, the earlier layers' tests and this layer's, by group.
        centres, radii: inner points (n, d), and how far all rows are from them (n,).
        bases: of the linear programs.
        n_ahead: tests of this layer that are still to come; they are the last rows.
    """

    outcomes: BoolArray
    signs: NDArray[np.int8]
    group: IntArray
    rows: Rows
    centres: FloatArray
    radii: FloatArray
    bases: Bases
    n_ahead: int

    def take(self, regions: NDArray[np.generic] | slice) -> _Block:
        return _Block(
            self.outcomes[regions], self.signs[regions], self.group[regions], self.rows, self.centres[regions],
            self.radii[regions], self.bases.take(regions), self.n_ahead,
        )  # fmt: skip


def find_regions(
    network: ReluNetwork,
    domain: Domain,
    *,
    tolerance: float = 1e-9,
    max_regions: int = 2**20,
    max_seconds: float | None = None,
) -> Regions:
    """Return every region of `network` in `domain` into which a ball of a radius above `tolerance` fits.

    Args:
        network: n hidden neurons; the tests of its head count as further ones.
        domain: where to look.
        tolerance: radius, in units of the domain's scale (half the box's width in each input; 1 where it has none).
        max_regions: refuse to find more.
        max_seconds: refuse to look longer.

    Raises:
        TreeTooLargeError: a limit was met; the message says how far the walk came.
    """
    return _Walk(network, domain, tolerance, max_regions, max_seconds).run()


class _Walk:
    def __init__(
        self, network: ReluNetwork, domain: Domain, tolerance: float, max_regions: int, max_seconds: float | None
    ) -> None:
        self.network, self.domain, self.tolerance = network, domain, tolerance
        self.max_regions, self.max_seconds = max_regions, max_seconds
        self.units = network.unit_form()
        self.n_bits = network.n_hidden + network.head.n_tests(network.n_outputs)
        self.n_linear_programs = self.n_tests = self.n_found = 0

    def run(self) -> Regions:
        self.began = time.monotonic()
        waiting, finished = [self._whole_domain()], []
        while waiting:
            block = waiting.pop()
            n_open = sum(len(other.group) for other in waiting)
            self._check_limits(block, n_open)
            if block.outcomes.shape[1] == self.n_bits:
                self.n_found += len(block.group)
                finished.append((block.outcomes, block.centres))
                continue
            if not block.n_ahead:
                waiting += self._next_layer(block)
                continue
            block = self._split(block)
            half = len(block.group) // 2
            waiting += (
                [block] if len(block.group) <= _BLOCK else [block.take(slice(half)), block.take(slice(half, None))]
            )
        patterns, centres = (np.concatenate(parts) for parts in zip(*finished, strict=True))
        return Regions(patterns, self.domain.unscaled(centres), self.n_linear_programs, self.n_tests)

    def _check_limits(self, block: _Block, n_open: int) -> None:
        seconds = time.monotonic() - self.began
        n_regions = self.n_found + n_open + len(block.group)
        if n_regions <= self.max_regions and (self.max_seconds is None or seconds <= self.max_seconds):
            return
        limit = f"{self.max_regions:,} regions" if n_regions > self.max_regions else f"{self.max_seconds:g} s"
        raise TreeTooLargeError(
            f"the limit of {limit} was met after {seconds:.1f} s: {self.n_found:,} regions were complete, "
            f"{n_regions - self.n_found:,} others followed to test {block.outcomes.shape[1]} of {self.n_bits} "
            "or less far; raise max_leaves or max_seconds, or give a smaller domain"
        )

    def _whole_domain(self) -> _Block:
        """Return the block of one region, the domain, before any test."""
        rows = self.domain.rows()
        signs, group = np.ones((1, rows.b.shape[1]), dtype=np.int8), np.zeros(1, dtype=np.int64)
        balls = largest_balls(rows, group, signs, Bases.start(1, self.network.n_inputs), self.tolerance)
        outcomes = np.zeros((1, 0), dtype=np.bool_)
        return _Block(outcomes, signs, group, rows, balls.centres, balls.radii, balls.bases, 0)

    def _next_layer(self, block: _Block) -> Iterator[_Block]:
        """Yield the block, in pieces, with the tests of the next layer, or the head's next one, among its rows."""
        if block.outcomes.shape[1] == 0:
            forms = self._tests(np.zeros((1, 0), dtype=np.bool_))
            yield self._with_tests(block, forms)
            return
        n_numbers = (block.signs.shape[1] + len(self.units.inputs)) * (self.network.n_inputs + 1)
        size = max(1, _BLOCK * 64 // n_numbers)
        for start in range(0, len(block.group), size):
            piece = block.take(slice(start, start + size))
            own_rows = Rows(piece.rows.a[piece.rows.of(piece.group)], piece.rows.b[piece.rows.of(piece.group)])
            piece.rows, piece.group = own_rows, np.arange(len(piece.group))
            yield self._with_tests(piece, self._tests(piece.outcomes))

    def _tests(self, outcomes: BoolArray) -> FloatArray:
        """Return the affine forms [P | v] of the next layer's tests, or the head's next one: (n, n_tests, d + 1)."""
        network, n_done = self.network, outcomes.shape[1]
        starts = self.units.layer_starts
        if n_done < network.n_hidden:
            layer = starts.index(n_done)
            return self.units.forms(outcomes, network.negative_slope, layer + 1)[:, n_done:]
        outputs = self.units.forms(outcomes[:, : network.n_hidden], network.negative_slope)[:, network.n_hidden :]
        return network.head.next_test(outputs, outcomes[:, network.n_hidden :])[:, None]

    def _with_tests(self, block: _Block, forms: FloatArray) -> _Block:
        """Return the block with tests (n_groups, n_tests, d + 1) added to its rows."""
        a, b = self.domain.scaled_forms(forms)
        rows = Rows(np.concatenate((block.rows.a, a), axis=1), np.concatenate((block.rows.b, b), axis=1))
        signs = np.zeros((len(block.group), rows.b.shape[1]), dtype=np.int8)
        signs[:, : block.signs.shape[1]] = block.signs
        return _Block(block.outcomes, signs, block.group, rows, block.centres, block.radii, block.bases, forms.shape[1])

    def _split(self, block: _Block) -> _Block:
        """Return the block after its next test: every region's sides that are not empty."""
        test = block.signs.shape[1] - block.n_ahead
        rows = Rows(block.rows.a[:, : test + 1], block.rows.b[:, : test + 1])
        self.n_tests += len(block.group)
        of_group = rows.of(block.group)
        values = np.einsum("nd,nd->n", block.centres, rows.a[of_group, test]) + rows.b[of_group, test]
        near = values > 0
        constant = self.domain.is_constant(rows.a[of_group, test], rows.b[of_group, test])
        is_clear = constant | (np.abs(values) > np.maximum(self.tolerance, _CLEAR_SHARE * block.radii))
        asked = np.concatenate((np.flatnonzero(~constant), np.flatnonzero(~is_clear)))
        right = np.concatenate((~near[~constant], near[~is_clear]))
        signs = block.signs[asked, : test + 1]
        signs[:, test] = np.where(right, 1, -1)
        balls = largest_balls(rows, block.group[asked], signs, block.bases.take(asked), self.tolerance)
        self.n_linear_programs += len(asked)
        clear, found = np.flatnonzero(is_clear), np.flatnonzero(~balls.is_empty)
        parents = np.concatenate((clear, asked[found]))
        outcomes = np.concatenate((near[clear], right[found]))
        signs = block.signs[parents]
        signs[:, test] = np.where(constant[parents], 0, np.where(outcomes, 1, -1))
        margins = np.where(constant[clear], block.radii[clear], np.minimum(block.radii[clear], np.abs(values[clear])))
        return _Block(
            np.column_stack((block.outcomes[parents], outcomes)),
            signs,
            block.group[parents],
            block.rows,
            np.concatenate((block.centres[clear], balls.centres[found])),
            np.concatenate((margins, balls.radii[found])),
            Bases.concatenate([block.bases.take(clear), balls.bases.take(found)]),
            block.n_ahead - 1,
        )
