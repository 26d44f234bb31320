"""Leaves' regions: who is inside, which are reached, and the bounds of affine functions on them."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings

import otr
from otr.core.domain import Domain, as_domain
from otr.geometry.regions import leaf_paths
from tests.core.strategies import Case, cases

BOX = (-2.0, 2.0)


def numbered(tree: otr.ObliqueTree) -> otr.ObliqueTree:
    return tree.replace(labels=np.arange(tree.n_leaves), head=otr.Identity())


def bounds(tree: otr.ObliqueTree, leaf: int, form: np.ndarray, box: tuple) -> tuple[float, float]:
    """Return the least and the largest value of an affine form on a leaf's region; all other leaves answer far off."""
    found = []
    for sign in (-1.0, 1.0):
        M, c = np.zeros((tree.n_leaves, 1, tree.n_inputs)), np.full((tree.n_leaves, 1), -1e6)
        M[leaf, 0], c[leaf, 0] = sign * form[:-1], sign * form[-1]
        only = tree.replace(M=M, c=c, labels=None, head=otr.Identity())
        found.append(sign * otr.output_range(only, box).high[0])
    return found[0], found[1]


@settings(max_examples=50)
@given(cases(max_layers=2))
def test_a_region_holds_the_states_that_take_its_path(case: Case) -> None:
    tree = otr.map_network(case.network)
    X = np.clip(case.states, *BOX)
    leaves, paths = tree.apply(X), zip(*leaf_paths(tree), strict=True)
    for leaf, (nodes, signs) in enumerate(paths):
        values = X @ tree.P[nodes].T + tree.v[nodes]
        inside = ((values > 0) == (signs > 0)).all(axis=1)
        # States on a boundary may be sent either way by rounding.
        clear = np.full(len(X), True) if case.exact else (np.abs(values) > 1e-9).all(axis=1)
        np.testing.assert_array_equal(inside[clear], (leaves == leaf)[clear])


@settings(max_examples=25)
@given(cases(max_layers=2))
def test_reached_leaves_and_bounds_on_them(case: Case) -> None:
    tree = otr.map_network(case.network)
    X = np.random.default_rng(0).uniform(*BOX, (2000, tree.n_inputs))
    leaves = tree.apply(X)
    reached = otr.reachable_labels(numbered(tree), BOX)
    assert set(leaves.tolist()) <= set(reached.tolist())
    for leaf in np.unique(leaves).tolist():
        form = tree.leaf_forms[leaf, 0]
        low, high = bounds(tree, leaf, form, BOX)
        there = X[leaves == leaf] @ form[:-1] + form[-1]
        assert low - 1e-7 <= there.min() and there.max() <= high + 1e-7


def test_a_worked_region() -> None:
    network = otr.ReluNetwork([[[1.0, 0.0], [1.0, 1.0]], [[1.0, 1.0]]], [[-1.0, 0.0], [0.0]])
    tree = otr.map_network(network)
    assert tree.apply([[0.5, 0.5], [1.0, 0.0], [1.5, 0.5], [0.0, 0.0]]).tolist() == [1, 1, 3, 0]
    box = ([-2.0, -2.0], [2.0, 2.0])  # leaf 1 is x <= 1 and x + y > 0
    assert bounds(tree, 1, np.array([0.0, 1.0, 0.0]), box) == pytest.approx((-1.0, 2.0))
    assert bounds(tree, 1, np.array([1.0, 1.0, 5.0]), box) == pytest.approx((5.0, 8.0))
    # Leaf 2 is x > 1 and x + y <= 0.
    assert 2 in otr.reachable_labels(numbered(tree), ([-2.0, -2.0], [2.0, -1.5]))
    assert 2 not in otr.reachable_labels(numbered(tree), ([-2.0, -0.5], [2.0, 2.0]))


def test_a_path_is_listed_from_the_root() -> None:
    tree = otr.ObliqueTree([1, ~0], [~2, ~1], [[1.0], [2.0]], [0.0, 1.0], np.zeros((3, 1, 1)), np.zeros((3, 1)))
    nodes, signs = leaf_paths(tree)
    assert nodes.tolist() == [[0, 1], [0, 1], [0, -1]] and signs.tolist() == [[-1, -1], [-1, 1], [1, 0]]
    single = leaf_paths(otr.ObliqueTree([], [], np.zeros((0, 2)), [], np.zeros((1, 1, 2)), [[1.0]]))
    assert single[0].shape == (1, 0)


def test_boxes_and_what_is_none() -> None:
    space = gym.spaces.Box(np.float32([-1.0, -np.inf]), np.float32([2.0, 3.0]))
    assert as_domain(space, 2) == as_domain(([-1.0, -np.inf], [2.0, 3.0]), 2)
    domain = Domain([0.0, -np.inf], [np.inf, 1.0])
    assert as_domain(domain, 2) == domain == Domain.from_dict(domain.to_dict())
    tree = otr.map_network(otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]]))
    for make, words in (
        (lambda: as_domain("everywhere", 2), r"expected None, a pair \(low, high\), a Box space or an otr.Domain"),
        (lambda: otr.output_range(tree, Domain([-np.inf], [1.0])), "expected a bounded box"),
        (lambda: Domain([0.0, 1.0], [1.0]), "low has shape"),
        (lambda: Domain([1.0], [0.0]), "expected low <= high"),
        (lambda: Domain([np.inf], [np.inf]), "expected low <= high"),
        (lambda: Domain([-np.inf], [-np.inf]), "expected low <= high"),
        (lambda: Domain([np.nan], [1.0]), "expected low <= high"),
    ):
        with pytest.raises(ValueError, match=words):
            make()
