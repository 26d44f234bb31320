"""Cells of a tree with labels whose states are near to where the network has the leaf's label: a piece, and the way.

What `otr.proof.verify` checks is found here by linear programs in exact arithmetic. Pieces are looked for around a
point of the cell: first its own piece with the label's tests won, then all within the distance allowed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import chain, islice

import numpy as np

from otr.clock import check_time
from otr.geometry.rational import Integers, nearest_state, without_denominators
from otr.geometry.rational_linear_programs import inner_point, largest_value
from otr.proof.certificate import Cell
from otr.proof.exact_cells import ExactCell, as_sum, cells_near, largest_in_cell
from otr.proof.exact_rows import TreeAndNetwork
from otr.proof.verify import Checker, brought_to

_MAX_PIECES = 20  # around a point, that are tried


def near_cell(checker: Checker, cell: Cell, exact: ExactCell, max_error: Fraction) -> Cell:
    """Return a cell with the proof that its states are near to a piece of the network that has the leaf's label.

    It is the first within `max_error` or, if there is none, the cell as it was.
    """
    pair = checker.pair
    for outcomes in _pieces(pair, exact, max_error):
        check_time()
        near = "".join("1" if outcome else "0" for outcome in outcomes)
        forms = [*pair.turned(outcomes), *(row.numbers for row in pair.sides.values())]
        if pair.in_box and near == cell.outcomes and not cell.near:  # the proofs may do, and only the way does not
            found = _proved(checker, _ways(pair, cell, forms, checker.least(cell, forms, exact.rows)[0]), max_error)
            if found is not None:
                return found
        proved = _with_proofs(pair, replace(cell, near=near), exact, forms)
        least = checker.least(proved, forms, exact.rows)[0]
        ways = (_ways(pair, proved, forms, least), _slivers(checker, proved, exact, forms, max_error))
        found = _proved(checker, chain(*ways), max_error)
        if found is not None:
            return found
    return cell


def _proved(checker: Checker, cells: Iterator[Cell], max_error: Fraction) -> Cell | None:
    """Return the first of some cells that is proved to be near enough."""
    return next((cell for cell in cells if checker.error(cell) <= max_error), None)


def _with_proofs(pair: TreeAndNetwork, cell: Cell, exact: ExactCell, forms: Sequence[Integers]) -> Cell:
    """Return a cell with sums that the forms, of tests and the domain's sides, are at least up to a remainder."""
    sums = tuple(as_sum(largest_in_cell(pair, exact, -form)[1]) for form in forms)
    return replace(cell, proofs=sums[: pair.n_tests], bounds=sums[pair.n_tests :])


def _pieces(pair: TreeAndNetwork, exact: ExactCell, distance: Fraction) -> Iterator[tuple[bool, ...]]:
    """Yield the outcomes of pieces with the leaf's label near a cell's point, each once."""
    assert pair.tree.labels is not None
    n, label = pair.network.n_hidden, int(pair.tree.labels[exact.leaf])
    head = exact.outcomes[n:]
    won = [*head[: label - 1], True] if label else []
    first = (*exact.outcomes[:n], *won, *[False] * (len(head) - len(won)))
    yield first
    for near in islice(cells_near(pair, exact.leaf, exact.point, distance), _MAX_PIECES):
        if near.outcomes != first and pair.label(near.outcomes) == label:
            yield near.outcomes


def _ways(pair: TreeAndNetwork, cell: Cell, forms: Sequence[Integers], least: Sequence[Fraction]) -> Iterator[Cell]:
    """Yield a cell with the shortest way to where no form is below 0, then with one to a point well inside.

    The forms are those of tests, then of the domain's sides; the values of a cell's states are not below -least. In a
    box of many inputs there are only ways to a point.
    """
    if not pair.in_box:
        yield from _shortest_way(pair, cell, forms, least)
    inside = inner_point(pair.written_out(np.array(forms))[0], [True] * len(forms), pair.box).point
    if pair.in_box and inside is not None and (state := nearest_state(inside)) is not None:
        yield replace(cell, towards=(*state.tolist(), 1.0))
    if inside is not None:
        yield replace(cell, towards=(*inside, Fraction(1)))


def _shortest_way(
    pair: TreeAndNetwork, cell: Cell, forms: Sequence[Integers], least: Sequence[Fraction]
) -> Iterator[Cell]:
    """Yield a cell with the shortest way to where no form is below 0, if there is one."""
    rows = [
        [*map(Fraction, form.tolist()), Fraction(0), -value * 2**pair.power]  # over p, s, the distance e, and 1
        for form, value in zip(forms, least, strict=True)
    ]
    d, unit = pair.domain.n_inputs, np.eye(pair.domain.n_inputs + 3, dtype=np.int64).astype(object)
    p, s, e = unit[:d], unit[d], unit[d + 1]
    rows.append(s.tolist())
    limits = list(zip(pair.domain.low.tolist(), pair.domain.high.tolist(), pair.widths(), strict=True))
    slack = dict(zip(pair.sides, least[pair.n_tests :], strict=True))
    for i, (low, high, width) in enumerate(limits):
        if np.isinf(low) or np.isinf(high):
            rows += [(e + form).tolist() for form in (p[i], -p[i], -s)]
        else:
            from_low, to_high = Fraction(low) - slack[f"low {i}"], Fraction(high) + slack[f"high {i}"]
            rows += [(e * width - p[i] + s * from_low).tolist(), (e * width + p[i] - s * to_high).tolist()]
    whole = np.array([without_denominators(list(map(Fraction, row)))[0] for row in rows], dtype=object)
    shortest = largest_value(whole, (-e).tolist(), Fraction(0))
    if shortest.point is not None:
        yield replace(cell, towards=shortest.point[: d + 1])


def _slivers(
    checker: Checker, cell: Cell, exact: ExactCell, forms: Sequence[Integers], max_error: Fraction
) -> Iterator[Cell]:
    """Yield a cell as a sliver along a test that is nowhere far from 0, by each input that brings it there."""
    pair = checker.pair
    if pair.in_box:
        return  # the input is to stay within sides that no sum is of
    for onto, row in enumerate(forms[: pair.n_tests]):
        check_time()
        thin = tuple(as_sum(largest_in_cell(pair, exact, form)[1]) for form in (-row, row))
        farthest = max(
            checker.shortfall(cell.leaf, form, proof, exact.rows) for form, proof in zip((row, -row), thin, strict=True)
        )
        for axis, width in enumerate(pair.widths()):
            if row[axis] and width and farthest * 2**pair.power <= max_error * width * abs(row[axis]):
                towards = tuple(Fraction(i == axis) for i in range(pair.domain.n_inputs + 1))
                brought = [brought_to(row, axis, form) for form in forms]
                yield replace(_with_proofs(pair, cell, exact, brought), towards=towards, thin=thin, onto=onto)
