"""The cells of a network inside a leaf's region, in exact arithmetic: however thin, with a point in each.

A cell is what the outcomes of the network's tests leave of the leaf's region; "0" is at most 0, "1" above it. One point
of a cell shows a side of the next test that is not empty, and a linear program in rational arithmetic decides whether
the other side is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.heads import Identity
from otr.errors import CertificateError, TimeLimitError
from otr.geometry.rational import Integers, Point, as_point, integers, nearest_state
from otr.geometry.rational_linear_programs import ExactBox, inner_point, largest_value
from otr.proof.certificate import Sum
from otr.proof.exact_rows import ExactRow, TreeAndNetwork, TreeOnDomain

_MAX_CELLS = 1000  # searched for a point that shows a refusal

Multipliers = dict[str, Fraction]  # of rows, by name


@dataclass(frozen=True)
class ExactCell:
    """A cell of a network inside a leaf's region.

    The rows are those of the leaf's region, and the tests that split it, as "neuron i". Every other test, in the
    direction of its outcome, is at least the sum of rows that its proof weighs.
    """

    leaf: int
    outcomes: tuple[bool, ...]  # of the network's tests, in order
    rows: dict[str, ExactRow]  # that bound it, by name
    proofs: dict[int, Multipliers]
    point: Point  # of the cell
    forms: Integers  # of the network's units in it


def decide(rows: dict[str, ExactRow], n_inputs: int) -> Point | Multipliers:
    """Return a point at which all rows hold, or multipliers that show that there is none."""
    return _point_or_multipliers(rows, stacked(rows, n_inputs), None)


def decide_in(pair: TreeOnDomain, rows: dict[str, ExactRow], box: ExactBox | None = None) -> Point | Multipliers:
    """Return a point of a domain at which rows in the coordinates of a pair hold, or multipliers as in `decide`.

    With a box, the point is in that instead.
    """
    return _point_or_multipliers(rows, pair.stacked(rows), pair.box if box is None else box)


def _point_or_multipliers(rows: dict[str, ExactRow], numbers: Integers, box: ExactBox | None) -> Point | Multipliers:
    names = list(rows)
    found = inner_point(numbers, [rows[name].is_strict for name in names], box)
    if found.t is not None and found.t > 0 and found.point is not None:
        return found.point
    return {names[row]: multiplier for row, multiplier in found.multipliers.items()}


def cells_of_leaf(pair: TreeAndNetwork, leaf: int) -> Iterator[ExactCell]:
    """Yield the network's cells in a leaf's region; none if it is empty."""
    rows = pair.rows_of_leaf(leaf)
    point = decide_in(pair, rows)
    if isinstance(point, tuple):
        yield from find_cells(pair, leaf, rows, point)


def find_cells(
    pair: TreeAndNetwork, leaf: int, rows: dict[str, ExactRow], point: Point, box: ExactBox | None = None
) -> Iterator[ExactCell]:
    """Yield the network's cells in a leaf's region of these rows, and of a box, in which a point is, depth first."""
    n = pair.network.n_hidden
    starts = set(pair.network.unit_form().layer_starts)
    waiting: list[tuple[tuple[bool, ...], dict[str, ExactRow], dict[int, Multipliers], Point, Integers]] = [
        ((), rows, {}, point, np.empty((0, 0), dtype=object))
    ]
    while waiting:
        outcomes, rows, proofs, point, forms = waiting.pop()
        test = len(outcomes)
        if test <= n and test in starts:
            forms = pair.forms(outcomes)
        if test == pair.n_tests:
            yield ExactCell(leaf, outcomes, rows, proofs, point, forms)
            continue
        padded = (*outcomes, *(False for _ in range(pair.n_tests - test)))
        form = forms[test] if test < n else pair.head_tests(forms, padded)[test - n]
        near = pair.values(form[None], point)[0] > 0
        name = f"neuron {test}"
        sides = {outcome: rows | {name: ExactRow(form if outcome else -form, outcome)} for outcome in (False, True)}
        far = decide_in(pair, sides[not near], box)
        if isinstance(far, tuple):
            waiting.append(((*outcomes, not near), sides[not near], proofs, far, forms))
            waiting.append(((*outcomes, near), sides[near], proofs, point, forms))
            continue
        own = far.pop(name)  # above 0, since the region itself is not empty
        proof = {row: multiplier / own for row, multiplier in far.items()}
        waiting.append(((*outcomes, near), rows, proofs | {test: proof}, point, forms))


def largest_gap(pair: TreeAndNetwork, cell: ExactCell) -> list[tuple[list[Point], Multipliers]]:
    """Return where each difference of leaf and network in a cell, and its negative, is largest, and what bounds it.

    These are points of the cell's closure, and multipliers of its rows. On a domain with open sides it is largest in
    units of 1 + the size of the open inputs, which may be reached only ever farther in a direction.
    """
    forms = pair.differences(cell.leaf, cell.forms, cell.outcomes)
    return [largest_in_cell(pair, cell, signed) for form in forms for signed in (form, -form)]


def largest_in_cell(pair: TreeAndNetwork, cell: ExactCell, form: Integers) -> tuple[list[Point], Multipliers]:
    """Return where a form, in the pair's coordinates, is largest in a cell, as `largest_gap`, and what bounds it."""
    rows, domain = pair.stacked(cell.rows), pair.domain
    names, is_open = list(cell.rows), np.isinf(domain.low) | np.isinf(domain.high)
    widest = Fraction(float(np.abs([domain.low[~is_open], domain.high[~is_open]]).max(initial=1.0)))
    box = None if is_open.any() else pair.box
    if is_open.any() and pair.box is not None:  # as rows, too, which no multiplier is asked for of
        rows = np.concatenate((rows, integers(domain.sides()[0])[0]))
    if is_open.any():  # x / s for x, with |x_i| <= 1 where it is open and 0 <= s <= 1
        limits = [np.eye(len(is_open) + 2, dtype=np.int64)[i] for i in (*np.flatnonzero(is_open), len(is_open))]
        ones = np.eye(len(is_open) + 2, dtype=np.int64)[-1]
        bounds = [*(ones - limit for limit in limits), *(ones + limit for limit in limits[:-1]), limits[-1]]
        rows = np.concatenate((np.column_stack((rows, [0] * len(rows))), np.array(bounds).astype(object)))
    written = pair.written_out(form)[0].tolist()
    numbers = [*written, 0] if is_open.any() else written
    best = largest_value(rows, numbers, sum(map(abs, numbers)) * (widest + 1) + 1, box)
    assert best.point is not None  # the cell is not empty
    multipliers = {names[row]: multiplier for row, multiplier in best.multipliers.items() if row < len(names)}
    if not is_open.any():
        return [best.point], multipliers
    *x, s = best.point
    if s > 0:
        return [tuple(value / s for value in x)], multipliers
    steps = [tuple(10**k * value for value in x) for k in (0, 3, 6, 9, 12)]
    return [tuple(a + b for a, b in zip(cell.point, step, strict=True)) for step in steps], multipliers


def largest_over(rows: Integers, form: FloatArray, domain: Domain) -> tuple[float, FloatArray]:
    """Return the largest value of a form (d + 1,) of float64 where no row is below 0, and a state (d,) where it is.

    The rows (m, d + 1) are integers, leave a point and hold the sides of the domain, which is bounded.
    """
    numbers, power = integers(form)
    widest = Fraction(float(max(np.abs(domain.low).max(), np.abs(domain.high).max())))
    best = largest_value(rows, numbers.tolist(), sum(map(abs, numbers.tolist())) * (widest + 1) + 1)
    assert best.t is not None and best.point is not None
    return float(best.t / 2**power), np.array([float(value) for value in best.point])


def counterexample(pair: TreeAndNetwork, cell: ExactCell, max_error: Fraction) -> Point | None:
    """Return a point of a cell where leaf and network differ by more than `max_error`, or None.

    On a domain with open sides the error is relative, and a point is searched among few.
    """
    candidates = [cell.point]
    for points, _ in largest_gap(pair, cell):
        # The farthest point may be on a side that the cell is without: from it, ever nearer to the point inside.
        candidates += [_between(far, cell.point, Fraction(1, 2**k)) for far in points for k in (60, 30, 10, 3, 1)]
    for point in candidates:
        if differs(pair, point, max_error) == cell.leaf:
            state = nearest_state(point)
            if state is None:
                return point
            rounded = as_point(state)
            shows_it = pair.is_inside(rounded) and differs(pair, rounded, max_error) == cell.leaf
            return rounded if shows_it else point
    return None


def differs(pair: TreeAndNetwork, point: Point, max_error: Fraction) -> int | None:
    """Return the leaf of a point of the domain where tree and network differ by more than an error, None elsewhere."""
    leaf, gap = pair.gap(point)
    if pair.tree.labels is None or not gap:
        return leaf if gap > max_error * pair.unit_at(point) else None
    near = list(islice(cells_near(pair, leaf, point, max_error), _MAX_CELLS))
    is_near = any(pair.label(cell.outcomes) == pair.tree.labels[leaf] for cell in near)
    return None if is_near or len(near) == _MAX_CELLS else leaf


def cells_near(pair: TreeAndNetwork, leaf: int, point: Point, distance: Fraction) -> Iterator[ExactCell]:
    """Yield the network's cells among the states of the domain that are no farther from a point, as labels count."""
    rows, unit = dict(pair.sides), pair.unit_at(point)
    reach = [distance * width * unit for width in pair.widths()]
    if pair.in_box:  # rounded outwards
        ends = [[float(value + sign * step) for value, step in zip(point, reach, strict=True)] for sign in (-1, 1)]
        low, high = np.nextafter(ends[0], -np.inf), np.nextafter(ends[1], np.inf)
        box = ExactBox(np.maximum(low, pair.domain.low), np.minimum(high, pair.domain.high))
        yield from find_cells(pair, leaf, rows, point, box)
        return
    for i, (value, step) in enumerate(zip(point, reach, strict=True)):
        for sign in (1, -1):
            limit = step - sign * value
            numbers = np.array([0] * len(point) + [limit.numerator], dtype=object)
            numbers[i] = sign * limit.denominator
            rows[f"near {sign} {i}"] = ExactRow(numbers, False)
    yield from find_cells(pair, leaf, rows, point)


def refusal(error: CertificateError, pair: TreeAndNetwork, max_error: float) -> CertificateError:
    """Return a refusal with a point of its leaf where tree and network differ, or unchanged if none is found soon."""
    if error.leaf is None or not 0 <= error.leaf < pair.tree.n_leaves:
        return error
    try:
        for cell in islice(cells_of_leaf(pair, error.leaf), _MAX_CELLS):
            point = counterexample(pair, cell, Fraction(max_error))
            if point is not None:
                return refused_at(pair, error.leaf, point)
    except TimeLimitError:  # it is refused in any case
        pass
    return error


def refused_at(pair: TreeAndNetwork, leaf: int, point: Point) -> CertificateError:
    """Return the error that says that tree and network differ at a point of a leaf."""
    tree, network = pair.tree, pair.network
    if tree.labels is None:
        ours: object = [_shown(value) for value in pair.outputs(leaf, point)]
        theirs: object = [_shown(value) for value in pair.units.outputs(point)]
    else:
        ours, theirs = int(tree.labels[leaf]), pair.label_at(point)
    what = "answers" if tree.labels is not None or network.head == Identity() else "computes, before its head,"
    state = ", ".join(_shown(value) for value in point)
    text = f"leaf {leaf}: at the state [{state}] the tree {what} {_listed(ours)} and the network {_listed(theirs)}"
    return CertificateError(f"{text}; they are not the same function", leaf, point)


def _listed(answer: object) -> str:
    return f"[{', '.join(answer)}]" if isinstance(answer, list) else str(answer)


def _shown(value: Fraction) -> str:
    """Return a number as text: as a float64 if it is one or nearly so, else as a fraction."""
    try:
        rounded = float(value)
    except OverflowError:
        return str(value) if value.numerator.bit_length() < 1000 else f"about 2**{value.numerator.bit_length()}"
    if rounded == value:
        return repr(rounded)
    digits = len(f"{value.numerator:x}") + len(f"{value.denominator:x}")
    return f"{rounded!r}..." if digits > 40 else f"{value.numerator}/{value.denominator}"


def _between(point: Point, other: Point, share: Fraction) -> Point:
    return tuple(a + (b - a) * share for a, b in zip(point, other, strict=True))


def stacked(rows: dict[str, ExactRow], n_inputs: int) -> Integers:
    """Return rows as one array (m, d + 1)."""
    return np.array([row.numbers for row in rows.values()], dtype=object).reshape(len(rows), n_inputs + 1)


def as_sum(multipliers: Multipliers) -> Sum:
    """Return multipliers by row as certificates hold them."""
    return Sum(tuple(multipliers), tuple(multipliers.values()))
