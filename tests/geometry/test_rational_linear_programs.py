"""Linear programs in rational arithmetic: a point that is one, or multipliers that show that there is none."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from otr.geometry.rational import (
    ExactTree,
    ExactUnits,
    as_point,
    at,
    independent_rows,
    integers,
    without_denominators,
)
from otr.geometry.rational_linear_programs import ExactBox, inner_point, largest_value
from tests.core.strategies import Case, cases


def random_rows(rng: np.random.Generator, m: int, d: int, degenerate: bool) -> np.ndarray:
    """Rows of floats; if degenerate, of few directions and offsets: parallels, and many through one point."""
    return rng.integers(-2, 3, (m, d + 1)).astype(float) if degenerate else rng.normal(size=(m, d + 1))


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 14), st.booleans())
def test_a_point_is_inside_and_multipliers_show_that_there_is_none(seed: int, d: int, m: int, degenerate: bool) -> None:
    rng = np.random.default_rng(seed)
    rows, _ = integers(random_rows(rng, m, d, degenerate))
    strict = rng.random(m) < 0.5
    found = inner_point(rows, strict)
    if found.t is not None and found.t > 0:
        values = at(rows, 0, found.point)
        assert all(value > 0 if is_strict else value >= 0 for value, is_strict in zip(values, strict, strict=True))
        return
    assert found.multipliers and all(multiplier > 0 for multiplier in found.multipliers.values())
    total = sum(rows[row] * multiplier for row, multiplier in found.multipliers.items())
    assert not any(total[:-1])
    assert total[-1] < 0 or (total[-1] == 0 and any(strict[row] for row in found.multipliers))


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(0, 8), st.booleans())
def test_largest_values_equal_highs(seed: int, d: int, m: int, degenerate: bool) -> None:
    rng = np.random.default_rng(seed)
    box = np.concatenate((np.column_stack((np.eye(d), np.ones(d))), np.column_stack((-np.eye(d), np.ones(d)))))
    rows, power = integers(np.concatenate((box, random_rows(rng, m, d, degenerate))))
    form = random_rows(rng, 1, d, degenerate)
    numbers, of_form = integers(form)
    found = largest_value(rows, numbers[0].tolist(), Fraction(10**30))
    floats = rows.astype(float) / 2.0**power
    solved = linprog(-form[0, :-1], -floats[:, :-1], floats[:, -1], bounds=(None, None))
    if found.t is None:
        assert solved.status == 2
        return
    assert float(found.t / 2**of_form) == pytest.approx(-solved.fun + form[0, -1], abs=1e-8)
    assert min(at(rows, 0, found.point)) >= 0
    assert at(numbers, 0, found.point) == [found.t]
    total = numbers[0] + sum((rows[row] * multiplier for row, multiplier in found.multipliers.items()), 0 * numbers[0])
    assert not any(total[:-1]) and total[-1] == found.t


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False), min_size=1, max_size=5))
def test_integers_are_the_floats(values: list[float]) -> None:
    exact, power = integers(np.array(values))
    assert [Fraction(value, 2**power) for value in exact.tolist()] == [Fraction(value) for value in values]


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 5))
def test_rows_are_sums_of_the_independent_ones(seed: int, n: int, d: int) -> None:
    rows = np.random.default_rng(seed).integers(-2, 3, (n, d)).astype(float)
    chosen, sums = independent_rows(rows)
    assert len(chosen) == np.linalg.matrix_rank(rows)
    np.testing.assert_allclose(sums @ rows[chosen].reshape(len(chosen), d), rows, atol=1e-12)


def test_worked_rows() -> None:
    assert independent_rows(np.array([[1.0, 1.0], [1.0, np.nextafter(1.0, 2.0)]]))[0] == [0, 1]
    touching, _ = integers(np.array([[1.0, 0.0], [-1.0, 0.0]]))  # x >= 0 and x <= 0
    assert inner_point(touching, [False, False]).point == (0,)
    nothing = inner_point(touching, [True, False])
    assert nothing.t == 0 and set(nothing.multipliers) == {0, 1}


@given(cases(heads=("identity",), max_layers=3))
def test_exact_outputs_are_those_of_network_and_tree(case: Case) -> None:
    import otr

    network = case.network
    tree = otr.map_network(network)
    exact, units = ExactTree(tree), ExactUnits(network)
    for x in case.states[:5]:
        point = as_point(x)
        outputs = [float(value) for value in units.outputs(point)]
        np.testing.assert_allclose(outputs, network.forward(x), rtol=1e-9, atol=1e-9)
        leaf = exact.leaf(point)
        np.testing.assert_allclose([float(v) for v in exact.outputs(leaf, point)], outputs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("denominators", [(2**62, 3), (2**63, 2), (2**65, 3), (2**1074, 10), (1, 1)])
def test_denominators_of_any_size_are_multiplied_away(denominators):
    row = [Fraction(1, each) for each in denominators]
    numbers, multiple = without_denominators(row)
    assert [Fraction(number, multiple) for number in numbers] == row
    assert multiple > 0 and {type(number) for number in numbers} == {int}


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 6))
def test_a_box_that_is_no_rows_gives_the_same(seed: int, m: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.integers(-3, 4, (m, d + 1)).astype(object)
    low = rng.integers(-2, 1, d).astype(float)
    high = low + rng.integers(0, 3, d) / 2
    sides = np.zeros((2 * d, d + 1), dtype=np.int64).astype(object)
    sides[:d, :d], sides[d:, :d] = 2 * np.eye(d, dtype=np.int64), -2 * np.eye(d, dtype=np.int64)
    sides[:, d] = [*(-2 * low).astype(int).tolist(), *(2 * high).astype(int).tolist()]
    strict = (rng.random(m) < 0.5).tolist()
    in_box = inner_point(rows, strict, ExactBox(low, high))
    with_rows = inner_point(np.concatenate((rows, sides)), [*strict, *[False] * (2 * d)])
    has_point = [found.t is not None and found.t > 0 for found in (in_box, with_rows)]
    assert has_point[0] == has_point[1] and (in_box.t is None or in_box.t == with_rows.t)
    if has_point[0]:
        assert all(a <= x <= b for a, x, b in zip(low.tolist(), in_box.point, high.tolist(), strict=True))
        values = rows @ np.array([*in_box.point, 1], dtype=object)
        assert all(value > 0 if above else value >= 0 for value, above in zip(values, strict, strict=True))
        return
    total = sum((rows[row] * value for row, value in in_box.multipliers.items()), np.zeros(d + 1, dtype=object))
    limits = zip(map(Fraction, low.tolist()), map(Fraction, high.tolist()), strict=True)
    highest = total[d] + sum(max(a * least, a * most) for a, (least, most) in zip(total[:d], limits, strict=True))
    assert highest < 0 or (highest == 0 and any(strict[row] for row in in_box.multipliers))


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.integers(1, 4), st.sampled_from((1.0, 3.0, 2.0**-30)))
def test_the_largest_value_in_a_box_is_a_sum_of_rows_in_it(seed: int, m: int, d: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    rows, form = rng.integers(-3, 4, (m, d + 1)).astype(object), rng.integers(-3, 4, d + 1).astype(object)
    rows[:, -1] = abs(rows[:, -1])  # 0 is in them
    found = largest_value(rows, form.tolist(), Fraction(100), ExactBox(np.full(d, -size), np.full(d, size)))
    assert form @ np.array([*found.point, 1], dtype=object) == found.t and max(map(abs, found.point)) <= size
    total = form + sum((rows[row] * value for row, value in found.multipliers.items()), 0 * form)
    assert total[-1] + sum(abs(total[:-1])) * Fraction(size) == found.t
