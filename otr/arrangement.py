"""The regions of a network: every activation pattern that some states have.

Those of one layer in few dimensions are found by their vertices (`otr.vertices`), all others by walking the tree of the
network's tests. All regions of a level are taken on together. Each knows an inner point, which tells one side of the
next test that is not empty; whether the other side is, too, is asked of `largest_balls`. Each level's tests are written
in the inputs, by layer: within a region of the layers before, a layer is an arrangement of hyperplanes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from otr.arrays import BoolArray, FloatArray, IntArray
from otr.domain import Domain
from otr.errors import TreeTooLargeError
from otr.linear_programs import Bases, Rows, check_tolerance, largest_balls, rounding_at
from otr.network import ReluNetwork
from otr.vertices import regions_at_vertices

__all__ = ["Block", "Regions", "Walk", "find_regions"]

_BLOCK = 2**13  # regions walked together; more are set aside, so that memory does not grow with their number
_AT_VERTICES_S = 2.0  # vertices take less: with less time than that, only the walk keeps to it
_CLEAR_SHARE = 0.05  # of its margin to other tests: an inner point so far from a new one is inner to its side


@dataclass(frozen=True)
class Regions:
    """Regions of a network, in no particular order.

    Attributes:
        patterns: (k, n_bits) bool, each region's activation pattern and the outcomes of the head's tests.
        inner_points: (k, d), a state inside each.
        n_linear_programs: solved to find them; none where vertices tell.
        n_tests: pairs of a region and a test that the walk looked at.
    """

    patterns: BoolArray
    inner_points: FloatArray
    n_linear_programs: int
    n_tests: int


@dataclass(frozen=True)
class Block:
    """Regions walked together, all up to the same test.

    Attributes:
        origin: (n,) int64, what the walk started from: 0, or a leaf of a tree.
        outcomes: (n, n_done) bool, of the tests so far.
        signs: (n, n_rows) int8, of the rows in a region's group; 0 where a row does not bound it.
        group: (n,) int64.
        rows: those that the walk started from, then a row a test: the earlier layers' and this layer's.
        centres, radii: inner points (n, d), and how far all rows are from them (n,); in the domain's scale.
        bases: of the linear programs.
        n_ahead: tests of this layer that are still to come; they are the last rows.
    """

    origin: IntArray
    outcomes: BoolArray
    signs: NDArray[np.int8]
    group: IntArray
    rows: Rows
    centres: FloatArray
    radii: FloatArray
    bases: Bases
    n_ahead: int = 0

    def take(self, regions: NDArray[np.generic] | slice) -> Block:
        """Return the block of some regions."""
        arrays = {name: getattr(self, name)[regions] for name in _BY_REGION}
        return replace(self, bases=self.bases.take(regions), **arrays)


_BY_REGION = ("origin", "outcomes", "signs", "group", "centres", "radii")


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
    check_tolerance(tolerance)
    is_one_layer = len(network.hidden_widths) == 1 and not network.head.n_tests(network.n_outputs)
    if is_one_layer and (max_seconds is None or max_seconds >= _AT_VERTICES_S):
        regions = _regions_of_a_layer(network, domain, tolerance, max_regions)
        if regions is not None and len(regions.patterns) <= max_regions:
            return regions
    rows = domain.rows()
    signs, group = np.ones((1, rows.n_rows), dtype=np.int8), np.zeros(1, dtype=np.int64)
    balls = largest_balls(rows, group, signs, Bases.start(1, network.n_inputs), tolerance)
    outcomes = np.zeros((1, 0), dtype=np.bool_)
    whole = Block(group, outcomes, signs, group, rows, balls.centres, balls.radii, balls.bases)
    walk = Walk(network, domain, tolerance, max_regions, max_seconds)
    blocks = walk.run(whole)
    return Regions(
        np.concatenate([block.outcomes for block in blocks]),
        domain.unscaled(np.concatenate([block.centres for block in blocks])),
        walk.n_linear_programs,
        walk.n_tests,
    )


def _regions_of_a_layer(network: ReluNetwork, domain: Domain, tolerance: float, max_regions: int) -> Regions | None:
    """Return the regions of a network of one layer without a walk, if its tests are in general position and few."""
    tests = domain.rows_of(np.column_stack((network.weights[0], network.biases[0]))[None])
    a, b = tests.a[0], tests.b[0]
    constant = domain.reach(a) < np.abs(b)
    sides = domain.rows()
    side_of = np.abs(sides.a[0]).argmax(axis=1)
    found = regions_at_vertices(
        np.concatenate((sides.a[0], a[~constant])),
        np.concatenate((sides.b[0], b[~constant])),
        np.concatenate((side_of, np.full((~constant).sum(), -1))),
        tolerance,
        max_regions,
    )
    if found is None:
        return None
    signs, centres = found
    patterns = np.tile(b > 0, (len(signs), 1))
    patterns[:, ~constant] = signs[:, len(side_of) :]
    return Regions(patterns, domain.unscaled(centres), 0, 0)


class Walk:
    """A walk through the tests of a network, from regions of the inputs to the regions of the network inside them."""

    def __init__(
        self, network: ReluNetwork, domain: Domain, tolerance: float, max_regions: int, max_seconds: float | None
    ) -> None:
        """Take the arguments of `find_regions`."""
        self.network, self.domain, self.tolerance = network, domain, tolerance
        self.max_regions, self.max_seconds = max_regions, max_seconds
        self.units = network.unit_form()
        self.n_bits = network.n_hidden + network.head.n_tests(network.n_outputs)
        self.n_linear_programs = self.n_tests = self.n_found = 0

    def run(self, start: Block) -> list[Block]:
        """Return all regions in those of `start`, which have no outcomes yet.

        Raises:
            TreeTooLargeError: as in `find_regions`.
        """
        self.began = time.monotonic()
        waiting, finished = [start], []
        while waiting:
            block = waiting.pop()
            self._check_limits(block, sum(len(other.group) for other in waiting))
            if block.outcomes.shape[1] == self.n_bits:
                self.n_found += len(block.group)
                finished.append(block)
            elif not block.n_ahead:
                waiting += self._next_layer(block)
            else:
                block = self._split(block)
                n = len(block.group)
                parts = [slice(None)] if n <= _BLOCK else [slice(n // 2), slice(n // 2, None)]
                waiting += [block.take(part) for part in parts]
        return finished

    def _check_limits(self, block: Block, n_open: int) -> None:
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

    def _next_layer(self, block: Block) -> Iterator[Block]:
        """Yield the block, in pieces, with the tests of the next layer, or the head's next one, among its rows."""
        if block.outcomes.shape[1] == 0:
            forms = self._tests(np.zeros((1, 0), dtype=np.bool_))
            yield self._with_tests(block, forms)
            return
        n_numbers = (block.signs.shape[1] + len(self.units.inputs)) * (self.network.n_inputs + 1)
        size = max(1, _BLOCK * 64 // n_numbers)
        for start in range(0, len(block.group), size):
            piece = block.take(slice(start, start + size))
            own_rows = piece.rows.take(piece.rows.of(piece.group))
            piece = replace(piece, rows=own_rows, group=np.arange(len(piece.group)))
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

    def _with_tests(self, block: Block, forms: FloatArray) -> Block:
        """Return the block with tests (n_groups or 1, n_tests, d + 1) added to its rows."""
        rows = block.rows.followed_by(self.domain.rows_of(forms))
        signs = np.zeros((len(block.group), rows.n_rows), dtype=np.int8)
        signs[:, : block.signs.shape[1]] = block.signs
        return replace(block, signs=signs, rows=rows, n_ahead=forms.shape[1])

    def _split(self, block: Block) -> Block:
        """Return the block after its next test: every region's sides that are not empty."""
        test = block.signs.shape[1] - block.n_ahead
        rows = block.rows.take(slice(None), slice(test + 1))
        self.n_tests += len(block.group)
        of_group = rows.of(block.group)
        values = np.einsum("nd,nd->n", block.centres, rows.a[of_group, test]) + rows.b[of_group, test]
        near = values > 0
        constant = self.domain.reach(rows.a[of_group, test]) < np.abs(rows.b[of_group, test])
        unclear = np.maximum(_CLEAR_SHARE * block.radii, rounding_at(block.centres))
        is_clear = constant | (np.abs(values) > np.maximum(self.tolerance, unclear))
        asked = np.concatenate((np.flatnonzero(~constant), np.flatnonzero(~is_clear)))
        right = np.concatenate((~near[~constant], near[~is_clear]))
        signs = block.signs[asked, : test + 1]
        signs[:, test] = np.where(right, 1, -1)
        balls = largest_balls(rows, block.group[asked], signs, block.bases.take(asked), self.tolerance)
        self.n_linear_programs += len(asked)
        found = np.flatnonzero(~balls.is_empty)
        n_found = np.bincount(asked[found], minlength=len(near)) + is_clear
        kept = np.flatnonzero(is_clear | (n_found == 0))  # with neither side wide enough, the region stays as it is
        parents = np.concatenate((kept, asked[found]))
        outcomes = np.concatenate((near[kept], right[found]))
        is_split = n_found[parents] == 2
        signs = block.signs[parents]
        signs[:, test] = np.where(is_split, np.where(outcomes, 1, -1), 0)
        margins = np.where(n_found == 2, np.minimum(block.radii, np.abs(values)), block.radii)[kept]
        return Block(
            block.origin[parents],
            np.column_stack((block.outcomes[parents], outcomes)),
            signs,
            block.group[parents],
            block.rows,
            np.concatenate((block.centres[kept], balls.centres[found])),
            np.concatenate((margins, balls.radii[found])),
            Bases.concatenate([block.bases.take(kept), balls.bases.take(found)]),
            block.n_ahead - 1,
        )
