"""Stacked policies answer as each of them does."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.control.search.policy_stack import stack_policies
from otr.control.search.state_moments import StateMoments
from tests.core.strategies import make_network


def networks(seed: int, k: int, widths: list[int], dense: str | bool, slope: float, head: otr.Head) -> list:
    generator = np.random.default_rng(seed)
    options = {"n_inputs": 4, "n_outputs": 3, "dense": dense, "negative_slope": slope}
    return [make_network(generator, tuple(widths), **options).replace(head=head) for _ in range(k)]


@given(
    seed=st.integers(0, 2**31),
    widths=st.lists(st.integers(1, 5), max_size=2),
    dense=st.sampled_from([False, "input", "all"]),
    slope=st.sampled_from([0.0, 0.1]),
    head=st.sampled_from([otr.ClipBox(-1.0, 1.0), otr.Argmax(), otr.TanhBox(-1.0, 2.0)]),
)
def test_networks_and_their_trees(seed, widths, dense, slope, head):
    policies = networks(seed, 3, widths, dense, slope, head)
    X = np.random.default_rng(seed).normal(size=(3, 5, 4))
    answers = stack_policies(policies).predict(X)
    np.testing.assert_allclose(answers, np.stack([p.predict(x) for p, x in zip(policies, X, strict=True)]), atol=1e-12)
    trees = [otr.map_network(policy) for policy in policies]
    answers = stack_policies(trees).predict(X)
    np.testing.assert_allclose(answers, np.stack([t.predict(x) for t, x in zip(trees, X, strict=True)]), atol=1e-9)


def test_labels_of_a_tree():
    maps = np.zeros((3, 2, 2)), np.zeros((3, 2))
    tree = otr.ObliqueTree([~0, ~1], [1, ~2], [[1.0, 0.0], [0.0, 1.0]], [0.0, -2.0], *maps, labels=[1, 0, 1])
    moved = tree.replace(v=tree.v - 1.0)
    X = np.array([[[0.5, 5.0], [-1.0, 0.0]], [[0.5, 5.0], [1.5, 2.5]]])
    assert np.array_equal(stack_policies([tree, moved]).predict(X), [tree.predict(X[0]), moved.predict(X[1])])
    for other in (tree.replace(labels=[1, 0, 0]), tree.replace(labels=None)):
        with pytest.raises(ValueError, match="trees of different structure, labels or heads"):
            stack_policies([tree, other])


def test_what_does_not_fit_together_is_refused():
    one, other = (networks(0, 1, [2], False, 0.0, otr.ClipBox(-size, size))[0] for size in (9.0, 1.0))
    wider = networks(0, 1, [3], False, 0.0, otr.ClipBox(-9.0, 9.0))[0]
    for policies, message in (
        ([one, other], "networks of different shapes or heads"),
        ([one, wider], "networks of different shapes"),
        ([otr.map_network(one), otr.map_network(other)], "trees of different structure, labels or heads"),
        ([], "no policies"),
    ):
        with pytest.raises(ValueError, match=message):
            stack_policies(policies)


@given(st.integers(0, 2**31), st.lists(st.integers(0, 30), min_size=1, max_size=5))
def test_moments_are_those_of_all_states(seed, sizes):
    states = np.random.default_rng(seed).normal(loc=[0.0, 1e3, 5.0], scale=[1.0, 2.0, 0.0], size=(sum(sizes), 3))
    moments = StateMoments(3)
    for batch in np.split(states, np.cumsum(sizes)[:-1]):
        moments.add(batch)
    if len(states) > 1:
        np.testing.assert_allclose(moments.mean, states.mean(axis=0))
        expected = states.std(axis=0)
        expected[2] = 1.0  # a constant
        np.testing.assert_allclose(moments.scale, expected)
