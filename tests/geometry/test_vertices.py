"""Regions by vertices: those of the walk, or none at all."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import otr
from otr.core.domain import Box, Domain, as_domain
from otr.geometry import arrangement
from otr.geometry.arrangement import Regions, find_regions
from otr.geometry.vertices import regions_at_vertices
from tests.core.strategies import make_network
from tests.geometry.test_minimal_tree import general_position

BOXES = (None, (-1.0, 1.0), (-3.0, np.inf), (-1e3, 1e3), ((-np.inf, -2.0, -np.inf, 0.0), (1.0, 2.0, np.inf, 4.0)))


def walked(network: otr.ReluNetwork, domain: Domain) -> Regions:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrangement, "regions_at_vertices", lambda *_: None)
        return find_regions(network, domain)


def rows(regions: Regions) -> set[bytes]:
    found = {row.tobytes() for row in regions.patterns}
    assert len(found) == len(regions.patterns)
    return found


@pytest.mark.parametrize(("n", "d"), [(1, 1), (1, 3), (6, 2), (8, 3), (8, 8), (6, 17), (32, 3), (24, 4)])
@pytest.mark.parametrize("box", BOXES[:2])
def test_no_test_is_walked_in_general_position(n: int, d: int, box: tuple[float, float] | None) -> None:
    network, domain = general_position(n, d), as_domain(box, d)
    regions, by_walk = find_regions(network, domain), walked(network, domain)
    assert by_walk.n_tests > 0
    assert rows(regions) == rows(by_walk)
    np.testing.assert_array_equal(network.patterns(regions.inner_points), regions.patterns)
    if box is None:
        assert len(regions.patterns) == sum(math.comb(n, i) for i in range(min(n, d) + 1))
    else:
        assert (np.abs(regions.inner_points) < 1).all()
    assert regions.n_tests == 0 or (box is not None and d > 4)


@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.integers(1, 4), st.sampled_from(BOXES), st.booleans())
def test_equals_the_walk(seed: int, n: int, d: int, box: Box | None, exact: bool) -> None:
    """Numbers of one digit make parallel, equal and constant tests, and vertices on the box or on many of them."""
    network = make_network(np.random.default_rng(seed), (n,), n_inputs=d, exact=exact)
    domain = as_domain(box if box is None or np.ndim(box) == 1 else tuple(limits[:d] for limits in box), d)
    regions = find_regions(network, domain)
    assume(regions.n_tests == 0)
    assert rows(regions) == rows(walked(network, domain))
    np.testing.assert_array_equal(network.patterns(regions.inner_points), regions.patterns)
    assert (regions.inner_points > domain.low).all()
    assert (regions.inner_points < domain.high).all()


@pytest.mark.parametrize("nearly", [0.0, 1e-12])
@pytest.mark.parametrize(
    ("a", "b"),
    [
        ([[1, 0], [0, 1], [1, 1]], [0, 0, 0]),  # three lines through a point
        ([[1, 0], [2, 0], [0, 1]], [0, -3, 0]),  # parallel ones
        ([[1, 0], [1, 0]], [1, 1]),  # equal ones
    ],
)
def test_without_general_position_there_is_no_answer(a: list[list[float]], b: list[float], nearly: float) -> None:
    normals, offsets = np.array(a) / np.linalg.norm(a, axis=1)[:, None], np.array(b, dtype=np.float64)
    normals[-1, 0] += nearly
    offsets[-1] += nearly
    assert regions_at_vertices(normals, offsets, np.full(len(b), -1), 2**20) is None


def test_what_is_left_to_the_walk_and_its_limits() -> None:
    corner = otr.ReluNetwork([[[1, 1], [1, -1]], [[1, 1]]], [[-2, 0.3], [0]])  # a vertex on a limit of the box
    regions = find_regions(corner, as_domain((-1.0, 1.0), 2))
    assert regions.n_tests > 0 and len(regions.patterns) == 2
    with pytest.raises(otr.TreeTooLargeError, match=r"0\.01 s"):
        find_regions(general_position(20, 20), as_domain(None, 20), max_seconds=0.01)
    with pytest.raises(otr.TreeTooLargeError, match="5,000 regions"):
        find_regions(general_position(32, 3), as_domain(None, 3), max_regions=5000)
    assert find_regions(general_position(16, 6), as_domain(None, 6)).n_tests > 0


@pytest.mark.parametrize(("n_boxed", "n", "d"), [(1, 1, 3), (1, 2, 4), (2, 3, 6), (1, 1, 2), (2, 2, 3), (1, 0, 2)])
def test_a_box_of_some_inputs(n_boxed: int, n: int, d: int) -> None:
    """The two limits of an input are one direction: with few neurons, no vertex may be left."""
    low, high = np.full(d, -np.inf), np.full(d, np.inf)
    low[:n_boxed], high[:n_boxed] = -1.0, 1.0
    network = make_network(np.random.default_rng(n), (max(n, 1),), n_inputs=d)
    if not n:  # a neuron that is constant
        network = otr.ReluNetwork([np.zeros((1, d)), [[1.0]]], [[1.0], [0.0]])
    regions = find_regions(network, Domain(low, high))
    assert rows(regions) == rows(walked(network, Domain(low, high)))
    assert len(regions.patterns) > 0
    assert otr.minimal_tree(network, (low, high)).n_leaves >= 1
