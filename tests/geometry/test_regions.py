"""Leaves' regions: who is inside, inner points, and the bounds of affine functions on them."""

import numpy as np
import pytest
from hypothesis import given, settings

import otr
from otr.core.domain import Domain, as_domain
from otr.geometry.regions import leaf_paths, leaf_region
from tests.core.strategies import Case, cases

BOX = (-2.0, 2.0)


@settings(max_examples=50)
@given(cases(max_layers=2))
def test_a_region_holds_the_states_that_take_its_path(case: Case) -> None:
    tree = otr.map_network(case.network)
    X = np.clip(case.states, *BOX)
    leaves = tree.apply(X)
    for leaf in np.unique(leaves).tolist():
        inside = leaf_region(tree, leaf, BOX).contains(X)
        if case.exact:
            np.testing.assert_array_equal(inside, leaves == leaf)
        else:  # states on a boundary may be sent either way by rounding
            paths = leaf_paths(tree)
            nodes = paths.nodes[leaf]
            values = X @ tree.P[nodes].T + tree.v[nodes]
            clear = (np.abs(values) > 1e-9).all(axis=1) if len(nodes) else np.ones(len(X), dtype=bool)
            np.testing.assert_array_equal(inside[clear], (leaves == leaf)[clear])


@settings(max_examples=50)
@given(cases(max_layers=2))
def test_inner_points_and_bounds(case: Case) -> None:
    tree = otr.map_network(case.network)
    X = np.random.default_rng(0).uniform(*BOX, (2000, tree.n_inputs))
    leaves = tree.apply(X)
    for leaf in range(tree.n_leaves):
        region = leaf_region(tree, leaf, BOX)
        point = region.inner_point()
        if point is None:
            assert (leaves == leaf).sum() == 0
            continue
        assert region.contains(point).all() and tree.apply(point) == leaf
        form = np.append(tree.M[leaf, 0], tree.c[leaf, 0])
        low, high = region.bounds(form)
        there = X[leaves == leaf] @ form[:-1] + form[-1]
        assert low - 1e-7 <= point @ form[:-1] + form[-1] <= high + 1e-7
        if len(there):
            assert low - 1e-7 <= there.min() and there.max() <= high + 1e-7


def test_a_worked_region() -> None:
    network = otr.ReluNetwork([[[1.0, 0.0], [1.0, 1.0]], [[1.0, 1.0]]], [[-1.0, 0.0], [0.0]])
    tree = otr.map_network(network)
    region = leaf_region(tree, 1, ([-2.0, -2.0], [2.0, 2.0]))  # x <= 1 and x + y > 0
    assert region.contains([[0.5, 0.5], [1.0, 0.0], [1.5, 0.5], [0.0, 0.0]]).tolist() == [True, True, False, False]
    assert region.bounds([0.0, 1.0, 0.0]) == pytest.approx((-1.0, 2.0))
    assert region.bounds([1.0, 1.0, 5.0]) == pytest.approx((5.0, 8.0))
    empty = leaf_region(tree, 2, ([-2.0, -2.0], [2.0, -1.5]))
    assert empty.inner_point() is not None
    assert leaf_region(tree, 2, ([-2.0, -0.5], [2.0, 2.0])).inner_point() is None  # x > 1 and x + y <= 0


def test_a_path_is_listed_from_the_root() -> None:
    tree = otr.ObliqueTree([1, ~0], [~2, ~1], [[1.0], [2.0]], [0.0, 1.0], np.zeros((3, 1, 1)), np.zeros((3, 1)))
    paths = leaf_paths(tree)
    assert paths.nodes.tolist() == [[0, 1], [0, 1], [0, -1]]
    assert paths.signs.tolist() == [[-1, -1], [-1, 1], [1, 0]]
    single = leaf_paths(otr.ObliqueTree([], [], np.zeros((0, 2)), [], np.zeros((1, 1, 2)), [[1.0]]))
    assert single.nodes.shape == (1, 0)


def test_bad_requests_are_told() -> None:
    tree = otr.map_network(otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]]))
    with pytest.raises(ValueError, match="leaf is 2, the tree has the leaves 0 to 1"):
        leaf_region(tree, 2)
    with pytest.raises(ValueError, match="expected a bounded box"):
        leaf_region(tree, 0).bounds([1.0, 0.0])
    with pytest.raises(ValueError, match="low has shape"):
        Domain([0.0, 1.0], [1.0])
    assert as_domain(Domain([0.0], [1.0]), 1) == Domain([0.0], [1.0])
    assert Domain.from_dict(Domain([0.0, -np.inf], [np.inf, 1.0]).to_dict()) == Domain([0.0, -np.inf], [np.inf, 1.0])
