"""Polytopes in a box whose sides are no rows: the same answers as with rows for them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otr.core.domain import Domain
from otr.geometry.arrangement import find_regions
from otr.geometry.largest_balls import largest_balls
from tests.core.strategies import Case, cases, make_network


@settings(max_examples=60)
@given(cases(max_layers=3), st.booleans(), st.booleans())
def test_the_regions_are_the_same_either_way(case: Case, half_open: bool, with_constant: bool) -> None:
    network = case.network
    low, high = np.full(network.n_inputs, -2.0), np.full(network.n_inputs, 1.5)
    high[-1] = np.inf if half_open else 1.5
    low[0] = high[0] if with_constant and np.isfinite(high[0]) else -2.0
    domain = Domain(low, high)
    with_rows = find_regions(network, domain)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Domain, "n_bounded", 10**9)
        in_box = find_regions(network, domain)
    inner = in_box.inner_points[~np.isnan(in_box.inner_points).any(axis=1)]
    assert ((inner >= low) & (inner <= high)).all()
    # Where floats cannot tell, a path may be kept that no state has: of both ways those count that have an inner point.
    sure = [{row.tobytes() for row, x in zip(r.patterns, r.inner_points, strict=True) if np.isfinite(x).all()}
            for r in (with_rows, in_box)]  # fmt: skip
    every = [{row.tobytes() for row in r.patterns} for r in (with_rows, in_box)]
    assert sure[0] <= every[1] and sure[1] <= every[0]


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(2, 9))
def test_a_ball_is_inside_and_an_empty_polytope_is_empty(seed: int, m: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    domain = Domain(np.full(d, -1.0), np.full(d, 1.0))
    forms = rng.normal(size=(1, m, d + 1))
    forms[..., -1] *= 2 * rng.random()
    signs = np.where(rng.random((40, m)) < 0.2, 0, np.where(rng.random((40, m)) < 0.5, -1, 1)).astype(np.int8)
    group = np.zeros(40, dtype=np.int64)
    rows = domain.rows(in_box=True).followed_by(domain.rows_of(forms))
    balls = largest_balls(rows, group, signs)
    values = np.where(signs == 0, np.inf, rows.values(group, balls.centres) * signs)
    found = balls.radii > 0
    assert (np.abs(balls.centres) <= 1).all() and (values[found].min(axis=1) >= balls.radii[found] * (1 - 1e-9)).all()
    of_rows = largest_balls(
        domain.rows().followed_by(domain.rows_of(forms)), group, np.column_stack((np.ones((40, 2 * d), np.int8), signs))
    )
    np.testing.assert_array_equal(balls.is_empty, of_rows.is_empty)
    np.testing.assert_array_equal(found, of_rows.radii > 0)


def test_wide_inputs_in_a_box_take_no_rows_for_its_sides() -> None:
    network = make_network(np.random.default_rng(0), (5,), n_inputs=300, n_outputs=2)
    domain = Domain(np.full(300, -1.0), np.full(300, 1.0))
    regions = find_regions(network, domain)
    assert len(regions.patterns) == 32 and (np.abs(regions.inner_points) <= 1).all()
    np.testing.assert_array_equal(network.patterns(regions.inner_points), regions.patterns)
    shifted = network.replace(biases=[network.biases[0] + 1000.0, network.biases[1]])
    assert find_regions(shifted, domain).patterns.tolist() == [[True] * 5]
