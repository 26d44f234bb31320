"""The regions of a network: every activation pattern that some states have.

Those of one layer in few dimensions are found by their vertices (`otr.geometry.vertices`), all others by walking the
tree of the network's tests. All regions of a level are processed together. Each has an inner point, which shows one
side of the next test that is not empty; whether the other side is, too, is asked of `largest_balls`. Where floating
point cannot decide, the side is kept, without an inner point. Each level's tests are written in the inputs, by layer:
within a region of the layers before, a layer is an arrangement of hyperplanes.

Of open inputs, those that a domain does not bound, only the directions matter that the network's weights on them span:
they are taken as inputs instead (`_in_fewer_inputs`), so that wide inputs cost no more than narrow ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from otr.clock import check_time, seconds_left, time_limit
from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.domain import Domain
from otr.core.half_spaces import HalfSpaces
from otr.core.network import ReluNetwork, UnitForm
from otr.errors import TreeTooLargeError
from otr.geometry.largest_balls import AnyBases, farthest, joined, largest_balls, rounding_at
from otr.geometry.rational import independent_rows
from otr.geometry.vertices import regions_at_vertices

_BLOCK = 2**13  # regions walked together; more are set aside, so that memory does not grow with their number
_WIDE = 48  # inputs in a box, from which on its sides are better no rows
_AT_VERTICES_S = 2.0  # vertices take less: with less time than that, only the walk keeps to it
_INDEPENDENT = 1e-6  # singular value of rows whose largest number is 1: beyond, they are beyond doubt
_CLEAR_SHARE = 0.05  # of its margin to other tests: an inner point so far from a new one is inner to its side


@dataclass(frozen=True)
class Regions:
    """Regions of a network, in no particular order."""

    patterns: BoolArray  # (k, n_bits), each region's activation pattern and the outcomes of the head's tests
    inner_points: FloatArray  # (k, d), a state inside each; NaN where rounding left none to be found
    n_tests: int  # pairs of a region and a test that the walk tried; none where vertices decide


@dataclass(frozen=True)
class Block:
    """Regions walked together, all up to the same test.

    The rows are those that the walk started from, then a row a test: the earlier layers' and this layer's. A radius of
    0 says that there is no inner point, and that the region may be empty.
    """

    origin: IntArray  # (n,), what the walk started from: 0, or a leaf of a tree
    outcomes: BoolArray  # (n, n_done), of the tests so far
    signs: NDArray[np.int8]  # (n, n_rows), of the rows in a region's group; 0 where a row does not bound it
    group: IntArray  # (n,)
    rows: HalfSpaces
    centres: FloatArray  # (n, d), inner points
    radii: FloatArray  # (n,), how far all rows are from these, in the domain's scale
    bases: AnyBases  # of the linear programs
    n_ahead: int = 0  # tests of this layer that are still to come; they are the last rows

    def take(self, regions: NDArray[np.generic] | slice) -> Block:
        """Return the block of some regions."""
        arrays = {name: getattr(self, name)[regions] for name in _BY_REGION}
        return replace(self, bases=self.bases.take(regions), **arrays)


_BY_REGION = ("origin", "outcomes", "signs", "group", "centres", "radii")


def find_regions(
    network: ReluNetwork, domain: Domain, *, max_regions: int = 2**20, max_seconds: float | None = None
) -> Regions:
    """Return every region of `network` in `domain`, but those that `largest_balls` calls empty.

    The tests of the network's head count as further neurons. Raise TreeTooLargeError, which says how far the walk came,
    beyond `max_regions` or `max_seconds`.
    """
    units, domain, embedding = _in_fewer_inputs(network.unit_form(), domain)
    walk = Walk(network, units, domain, max_regions)
    with time_limit(max_seconds, walk.reached):
        regions = _walked(walk)
    return replace(regions, inner_points=regions.inner_points @ embedding)


def _walked(walk: Walk) -> Regions:
    """Return the regions of a walk's network, in its inputs: by vertices where that is quick."""
    network, units, domain, max_regions = walk.network, walk.units, walk.domain, walk.max_regions
    is_one_layer = len(network.hidden_widths) == 1 and not network.head.n_tests(network.n_outputs)
    in_box = domain.n_bounded >= max(_WIDE, walk.n_bits)
    if is_one_layer and not in_box and seconds_left() >= _AT_VERTICES_S:
        regions = _regions_of_a_layer(units, domain, network.n_hidden, max_regions)
        if regions is not None and len(regions.patterns) <= max_regions:
            return regions
    rows = domain.rows(in_box=in_box)
    signs, group = np.ones((1, rows.n_rows), dtype=np.int8), np.zeros(1, dtype=np.int64)
    balls = largest_balls(rows, group, signs)
    outcomes = np.zeros((1, 0), dtype=np.bool_)
    whole = Block(group, outcomes, signs, group, rows, balls.centres, balls.radii, balls.bases)
    patterns, points = [], []
    for block in walk.run(whole):
        patterns.append(block.outcomes)
        points.append(domain.unscaled(np.where(block.radii[:, None] > 0, block.centres, np.nan)))
    return Regions(np.concatenate(patterns), np.concatenate(points), walk.n_tests)


def _in_fewer_inputs(units: UnitForm, domain: Domain) -> tuple[UnitForm, Domain, FloatArray]:
    """Return the network with independent products of its weights with the open inputs in the place of these.

    The regions are the same, as x of open inputs only counts as these products, which take all values. With it come the
    domain of these inputs, and the matrix (n_fewer, d) that gives a state of every one of theirs.
    """
    is_open = np.isinf(domain.low) & np.isinf(domain.high)
    of_open = units.inputs[:, is_open]
    reading = np.flatnonzero(of_open.any(axis=1))
    if not len(reading) or len(reading) >= is_open.sum():
        return units, domain, np.eye(domain.n_inputs)
    lengths = np.abs(of_open[reading]).max(axis=1, keepdims=True)
    if np.linalg.svd(of_open[reading] / lengths, compute_uv=False).min(initial=1.0) > _INDEPENDENT:
        chosen, sums = list(range(len(reading))), np.eye(len(reading))
    else:
        chosen, sums = independent_rows(of_open[reading])
    products = np.zeros((len(of_open), len(chosen)))
    products[reading] = sums
    n_closed = domain.n_inputs - int(is_open.sum())
    embedding = np.zeros((n_closed + len(chosen), domain.n_inputs))
    embedding[:n_closed, ~is_open] = np.eye(n_closed)
    embedding[n_closed:, is_open] = np.linalg.pinv(of_open[reading[chosen]]).T
    inputs = np.concatenate((units.inputs[:, ~is_open], products), axis=1)
    low, high = (np.append(limits[~is_open], np.full(len(chosen), np.inf)) for limits in (-domain.low, domain.high))
    return replace(units, inputs=inputs), Domain(-low, high), embedding


def _regions_of_a_layer(units: UnitForm, domain: Domain, n_hidden: int, max_regions: int) -> Regions | None:
    """Return the regions of a network of one layer without a walk, if its tests are in general position and few."""
    tests = domain.rows_of(np.column_stack((units.inputs, units.offsets))[None, :n_hidden])
    a, b = tests.a[0], tests.b[0]
    constant = domain.reach(a) < np.abs(b)
    sides = domain.rows()
    side_of = np.abs(sides.a[0]).argmax(axis=1)
    found = regions_at_vertices(
        np.concatenate((sides.a[0], a[~constant])),
        np.concatenate((sides.b[0], b[~constant])),
        np.concatenate((side_of, np.full((~constant).sum(), -1))),
        max_regions,
    )
    if found is None:
        return None
    signs, centres = found
    patterns = np.tile(b > 0, (len(signs), 1))
    patterns[:, ~constant] = signs[:, len(side_of) :]
    return Regions(patterns, domain.unscaled(centres), 0)


class Walk:
    """A walk through the tests of a network, from regions of the inputs to the regions of the network inside them."""

    def __init__(self, network: ReluNetwork, units: UnitForm, domain: Domain, max_regions: int) -> None:
        """Take the arguments of `find_regions`, and the units of the network in the inputs of the domain."""
        self.network, self.units, self.domain = network, units, domain
        self.max_regions = max_regions
        self._sizes = UnitForm(np.abs(units.links), np.abs(units.inputs), np.abs(units.offsets), units.layer_starts)
        self.n_bits = network.n_hidden + network.head.n_tests(network.n_outputs)
        # Values of tests up to which a side is left out, though states are in it; and as a share of the inner point's.
        self.thin, self.thin_share = np.zeros(self.n_bits), 0.0
        self.n_linear_programs = self.n_tests = self.n_found = self.n_thin = 0
        self._n_open = self._n_done = 0  # regions that are not complete, and the tests that the last of them followed

    def run(self, start: Block) -> Iterator[Block]:
        """Yield all regions in those of `start`, which have no outcomes yet, in blocks; errors are `find_regions`'s."""
        waiting = [start]
        while waiting:
            block = waiting.pop()
            self._n_open = sum(len(other.group) for other in (block, *waiting))
            self._n_done = block.outcomes.shape[1]
            self._check_limits()
            if block.outcomes.shape[1] == self.n_bits:
                self.n_found += len(block.group)
                yield block
            elif not block.n_ahead:
                waiting += self._next_layer(block)
            else:
                block = self._split(block)
                n = len(block.group)
                parts = [slice(None)] if n <= _BLOCK else [slice(n // 2), slice(n // 2, None)]
                waiting += [block.take(part) for part in parts]

    def _check_limits(self) -> None:
        check_time()
        if self.n_found + self._n_open > self.max_regions:
            raise TreeTooLargeError(
                f"the limit of {self.max_regions:,} regions was met: {self.reached()}; raise the limit, or give a "
                "smaller domain"
            )

    def reached(self) -> str:
        """Return the progress of the walk, as text."""
        return (
            f"{self.n_found:,} regions were complete, {self._n_open:,} others followed to test {self._n_done} of "
            f"{self.n_bits} or less far"
        )

    def _next_layer(self, block: Block) -> Iterator[Block]:
        """Yield the block, in pieces, with the tests of the next layer, or the head's next one, among its rows."""
        if block.outcomes.shape[1] == 0:
            yield self._with_tests(block, np.zeros((1, 0), dtype=np.bool_))
            return
        n_numbers = (block.signs.shape[1] + len(self.units.inputs)) * (self.domain.n_inputs + 1)
        size = max(1, _BLOCK * 64 // n_numbers)
        for start in range(0, len(block.group), size):
            piece = block.take(slice(start, start + size))
            own_rows = piece.rows.take(piece.rows.of(piece.group))
            piece = replace(piece, rows=own_rows, group=np.arange(len(piece.group)))
            yield self._with_tests(piece, piece.outcomes)

    def _tests(self, outcomes: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return the affine forms [P | v] (n, n_tests, d + 1) of the next layer's tests, or the head's next one.

        Also as many numbers: the size of the terms whose sums they are, the larger the more terms.
        """
        network, n_done = self.network, outcomes.shape[1]
        n, slope, starts = network.n_hidden, network.negative_slope, self.units.layer_starts
        n_layers = starts.index(n_done) + 1 if n_done < n else None
        forms, sizes = (units.forms(outcomes[:, :n], slope, n_layers) for units in (self.units, self._sizes))
        sizes *= 1 + min(n_done, n) / 8
        if n_done < n:
            return forms[:, n_done:], sizes[:, n_done:]
        test = network.head.next_test(forms[:, n:], outcomes[:, n:])[:, None]
        return test, np.broadcast_to(2 * sizes[:, n:].max(axis=1, keepdims=True), test.shape)

    def _with_tests(self, block: Block, outcomes: BoolArray) -> Block:
        """Return the block with the tests that follow `outcomes`, (n_groups or 1, n_done), added to its rows."""
        forms, sizes = self._tests(outcomes)
        rows = block.rows.followed_by(self.domain.rows_of(forms, sizes))
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
        constant = self.domain.reach(rows.a[of_group, test]) < np.abs(rows.b[of_group, test])
        near = np.where(constant, rows.b[of_group, test], values) > 0  # a region without an inner point has no centre
        unclear = np.maximum(_CLEAR_SHARE * block.radii, rounding_at(block.centres))
        is_clear = constant | ((block.radii > 0) & (np.abs(values) > unclear))
        asked = np.concatenate((np.flatnonzero(~constant), np.flatnonzero(~is_clear)))
        right = np.concatenate((~near[~constant], near[~is_clear]))
        signs = block.signs[asked, : test + 1]
        signs[:, test] = np.where(right, 1, -1)
        balls = largest_balls(rows, block.group[asked], signs, block.bases.take(asked), test)
        self.n_linear_programs += len(asked)
        found = np.flatnonzero(~balls.is_empty)
        thin = self.thin[block.outcomes.shape[1]] + self.thin_share * np.abs(values) * rows.lengths[of_group, test]
        if thin.any():
            reached = farthest(rows, block.group[asked[found]], signs[found], balls.bases.take(found), test)
            is_thin = reached <= thin[asked[found]]
            self.n_thin += int(is_thin.sum())
            found = found[~is_thin]
        n_found = np.bincount(asked[found], minlength=len(near)) + is_clear
        kept = np.flatnonzero(is_clear | (n_found == 0))  # a test that is 0 up to rounding does not split it
        has_both = n_found[asked[found]] == 2
        found, n_alone = np.concatenate((found[~has_both], found[has_both])), int((~has_both).sum())
        parents = np.concatenate((kept, asked[found]))
        outcomes = np.concatenate((near[kept], right[found]))
        is_split = n_found[parents] == 2
        signs = block.signs[parents]
        signs[:, test] = np.where(is_split, np.where(outcomes, 1, -1), 0)
        margins = np.where(n_found == 2, np.minimum(block.radii, np.abs(values)), block.radii)[kept]
        # Where the test's row bounds no region, that goes on from the basis before, which has no such row.
        bases = [block.bases.take(parents[: len(kept) + n_alone]), balls.bases.take(found[n_alone:])]
        return Block(
            block.origin[parents],
            np.column_stack((block.outcomes[parents], outcomes)),
            signs,
            block.group[parents],
            block.rows,
            np.concatenate((block.centres[kept], balls.centres[found])),
            np.concatenate((margins, balls.radii[found])),
            joined(bases),
            block.n_ahead - 1,
        )
