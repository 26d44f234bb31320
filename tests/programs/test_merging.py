import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.programs.merging import merge_equal_leaves
from tests.core.test_tree import random_tree, small_tree


def equal_siblings(tree: otr.ObliqueTree) -> list[int]:
    answers = [*zip(tree.M.tolist(), tree.c.tolist(), strict=True)] if tree.labels is None else tree.labels.tolist()
    sides = zip(tree.children_left.tolist(), tree.children_right.tolist(), strict=True)
    return [i for i, (a, b) in enumerate(sides) if a < 0 and b < 0 and answers[~a] == answers[~b]]


@given(st.integers(0, 2**32 - 1), st.integers(1, 25))
def test_the_side_of_a_constant_test_that_no_state_takes_goes(seed: int, n_leaves: int) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, n_leaves, 2, 1, 6)
    is_constant = rng.random(tree.n_nodes) < 0.4
    tree = tree.replace(P=np.where(is_constant[:, None], 0.0, tree.P))
    merged = merge_equal_leaves(tree)
    X = rng.normal(size=(200, 2))
    np.testing.assert_allclose(merged.predict(X), tree.predict(X), rtol=1e-9, atol=1e-12)
    assert merged.P.any(axis=1).all() and (merged is tree) == (not is_constant.any())


@given(st.integers(0, 2**32 - 1), st.integers(1, 25), st.booleans())
def test_the_merged_tree_acts_the_same_and_has_no_equal_siblings(seed: int, n_leaves: int, labelled: bool) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, n_leaves, 2, 1, 6)
    kinds = rng.integers(3, size=n_leaves)
    kind = kinds % n_leaves
    tree = tree.replace(labels=kinds) if labelled else tree.replace(M=tree.M[kind], c=tree.c[kind])
    merged = merge_equal_leaves(tree)
    X = rng.normal(size=(200, 2))
    np.testing.assert_allclose(merged.predict(X), tree.predict(X), rtol=1e-9, atol=1e-12)
    assert not equal_siblings(merged)
    assert (merged is tree) == (not equal_siblings(tree))


def test_a_tree_that_always_answers_the_same_is_one_leaf() -> None:
    assert merge_equal_leaves(small_tree(labels=[4, 4, 4])).n_leaves == 1
    one = merge_equal_leaves(small_tree(c=[[10.0], [20.0], [20.0]]))
    assert (one.n_leaves, one.c.tolist()) == (2, [[10.0], [20.0]])
    # Leaves that differ in the last bit, or are equal but no siblings, stay.
    assert merge_equal_leaves(small_tree(c=[[10.0], [20.0], [np.nextafter(20.0, 21)]])).n_leaves == 3
    assert merge_equal_leaves(small_tree(labels=[4, 3, 4])).n_leaves == 3
    of_basis = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], [[[2.0]]] * 2, [[0.5]] * 2, basis=np.ones((1, 3)))
    assert merge_equal_leaves(of_basis).n_leaves == 1
