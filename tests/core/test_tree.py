import copy
import itertools
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.core import leaf_maps as leaves
from otr.core import routing
from tests.core.strategies import Case, cases, make_network


def small_tree(**changes: object) -> otr.ObliqueTree:
    """x <= 0: leaf 0; else y <= 1: leaf 1, else leaf 2."""
    arrays: dict = {
        "children_left": [~0, ~1],
        "children_right": [1, ~2],
        "P": [[1.0, 0.0], [0.0, 1.0]],
        "v": [0.0, -1.0],
        "M": np.zeros((3, 1, 2)),
        "c": [[10.0], [20.0], [30.0]],
    }
    arrays.update(changes)
    return otr.ObliqueTree(**arrays)


def random_tree(rng: np.random.Generator, n_leaves: int, d: int, o: int, n_tests: int) -> otr.ObliqueTree:
    """A tree of random shape whose nodes draw from `n_tests` distinct tests in no order."""
    n_nodes = n_leaves - 1
    left, right = np.empty(n_nodes, dtype=int), np.empty(n_nodes, dtype=int)
    free: list[tuple[np.ndarray, int]] = []
    for node in range(n_nodes):
        if node:
            side, parent = free.pop(rng.integers(len(free)))
            side[parent] = node
        free += [(left, node), (right, node)]
    for leaf, (side, parent) in enumerate(free):
        side[parent] = ~leaf
    test = rng.integers(n_tests, size=n_nodes)
    P, v = rng.normal(size=(n_tests, d)), rng.normal(size=n_tests) / 2
    return otr.ObliqueTree(
        left, right, P[test], v[test], rng.normal(size=(n_leaves, o, d)), rng.normal(size=(n_leaves, o))
    )


def naive_walk(tree: otr.ObliqueTree, x: np.ndarray) -> tuple[int, list[int]]:
    reference, path = (0, []) if tree.n_nodes else (~0, [])
    while reference >= 0:
        path.append(reference)
        side = tree.children_left if tree.P[reference] @ x + tree.v[reference] <= 0 else tree.children_right
        reference = int(side[reference])
    return ~reference, path


def assert_routes_like_the_naive_walk(tree: otr.ObliqueTree, X: np.ndarray) -> None:
    walks = [naive_walk(tree, x) for x in X]
    expected = [leaf for leaf, _ in walks]
    assert tree.apply(X).tolist() == expected
    assert [int(tree.apply(x)) for x in X] == expected
    paths = tree.decision_path(X)
    assert paths.shape == (len(X), tree.n_nodes)
    assert [paths.indices[a:b].tolist() for a, b in zip(paths.indptr, paths.indptr[1:], strict=False)] == [
        path for _, path in walks
    ]
    outputs = np.array([tree.M[leaf] @ x + tree.c[leaf] for leaf, x in zip(expected, X, strict=True)])
    np.testing.assert_allclose(tree.forward(X), outputs, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose([tree.forward(x) for x in X], outputs, rtol=1e-9, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 5), st.integers(1, 3), st.integers(1, 30))
def test_any_tree_routes_like_the_naive_walk(seed: int, n_leaves: int, d: int, o: int, n_tests: int) -> None:
    rng = np.random.default_rng(seed)
    assert_routes_like_the_naive_walk(random_tree(rng, n_leaves, d, o, n_tests), rng.normal(size=(30, d)))


@given(cases())
def test_a_mapped_tree_routes_like_the_naive_walk(case: Case) -> None:
    tree = otr.map_network(case.network)
    X = case.states if case.exact else case.states[:40]
    assert_routes_like_the_naive_walk(tree, X)


@pytest.mark.parametrize("limits", itertools.product([512, 0], [2**20, 0], [128, 0]))
def test_every_way_of_routing_agrees(monkeypatch: pytest.MonkeyPatch, limits: tuple[int, int, int]) -> None:
    for name, limit in zip(("SHARED_TESTS", "TABLE_ENTRIES", "SHARED_TESTS_SINGLE"), limits, strict=True):
        monkeypatch.setattr(routing, f"_MAX_{name}", limit)
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 3))
    for widths in ((11,), (3, 4), (2, 2, 2)):
        assert_routes_like_the_naive_walk(otr.map_network(make_network(rng, widths)), X)


@pytest.mark.parametrize("max_outputs", [10**9, 0], ids=["all leaves at once", "gathered"])
def test_every_way_of_evaluating_leaves_agrees(monkeypatch: pytest.MonkeyPatch, max_outputs: int) -> None:
    monkeypatch.setattr(leaves, "_ALL_LEAVES_MAX_OUTPUTS", max_outputs)
    monkeypatch.setattr(leaves, "_CHUNK_BYTES", 2**10)
    rng = np.random.default_rng(0)
    tree = random_tree(rng, 30, 4, 2, 12)
    assert_routes_like_the_naive_walk(tree, rng.normal(size=(500, 4)))


def test_a_chain_deeper_than_the_recursion_limit() -> None:
    n = 3000
    sides, answers = (~np.arange(n), np.append(np.arange(1, n), ~n)), np.arange(n + 1.0)[:, None]
    tree = otr.ObliqueTree(*sides, np.ones((n, 1)), -np.arange(n, dtype=float), np.zeros((n + 1, 1, 1)), answers)
    assert tree.depth == n
    X = np.array([[-0.5], [0.0], [0.5], [1.0], [2998.5], [5000.0]])
    assert tree.predict(X).ravel().tolist() == [0, 0, 1, 1, 2999, 3000]
    assert otr.to_text(tree).count("if ") == n


def test_labels_answer_and_outputs_stay() -> None:
    tree = small_tree(labels=[7, 8, 9])
    X = np.array([[-1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    assert tree.predict(X).tolist() == [7, 8, 9] and tree.predict(X[2]) == 9
    assert tree.forward(X).ravel().tolist() == [10, 20, 30]
    assert small_tree().predict(np.array([1, 2], dtype=np.float32)).tolist() == [30.0]
    assert small_tree().predict([[1, 2]]).tolist() == [[30.0]]
    for each in (small_tree(), otr.map_network(make_network(np.random.default_rng(0), (8,), n_inputs=2))):
        shapes = [call(np.empty((0, 2))).shape for call in (each.predict, each.apply, each.decision_path)]
        assert shapes == [(0, 1), (0,), (0, each.n_nodes)]
    assert (tree.get_depth(), tree.get_n_leaves()) == (2, 3) == (tree.depth, tree.n_leaves)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"children_right": [1, ~1]}, "leaf 1 has 2 parents|leaf 2 has 0 parents"),
        ({"children_right": [0, ~2]}, "node 0 has the child 0"),
        ({"children_right": [2, ~2]}, "outside -3 .. 1"),
        ({"children_left": [~3, ~1]}, "outside -3 .. 1"),
        ({"children_left": [1, ~1]}, "node 1 has 2 parents|leaf 0 has 0 parents"),
        ({"v": [0.0, np.nan]}, "v holds a number that is not finite"),
        ({"M": np.full((3, 1, 2), np.inf)}, "M holds"),
        ({"c": np.zeros((3, 2))}, r"c has shape \(3, 2\), expected \(3, 1\)"),
        ({"P": np.zeros((2, 3))}, r"P has shape \(2, 3\), expected \(2, 2\)"),
        ({"P": np.zeros(2)}, "1, 1, 3 axes"),
        ({"labels": [1]}, r"labels has shape \(1,\)"),
        ({"labels": [0, 1, -1], "head": otr.Sign()}, r"labels hold \[0, 1, -1\], expected numbers below 2"),
        ({"labels": [0.0, 1.5, 1.0]}, r"\[0.0, 1.5, 1.0\] holds a number that is not whole"),
        ({"M": np.zeros((0, 1, 2))}, "expected"),
        ({"M": np.zeros((3, 0, 2)), "c": np.zeros((3, 0))}, "at least one"),
    ],
)
def test_broken_trees_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(otr.InvalidTreeError, match=message):
        small_tree(**changes)


def test_copies_are_read_only_too() -> None:
    network = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]])
    for copied in (lambda policy: policy, copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))):
        tree = copied(small_tree())
        assert not tree.v.flags.writeable and not copied(network).weights[0].flags.writeable
        np.testing.assert_array_equal(tree.predict([[1, 2]]), small_tree().predict([[1, 2]]))


def test_names_stay_with_a_tree_while_they_fit(tmp_path) -> None:
    plain = otr.map_network(otr.ReluNetwork([np.ones((2, 2)), np.ones((3, 2))], [[0, 1], [0, 1, 2]]))
    tree = plain.replace(feature_names=["position", "speed"], output_names=["left", "up", "right"])
    pruned = otr.prune_unreached(tree, np.random.default_rng(0).normal(size=(9, 2)))
    otr.save(pruned, tmp_path / "tree")
    for kept in (pruned, otr.load(tmp_path / "tree"), tree.replace(c=2 * tree.c)):
        assert (kept.feature_names, kept.output_names) == (("position", "speed"), ("left", "up", "right"))
        assert "speed" in otr.to_text(kept) and "up = " in otr.to_text(kept)
    assert "velocity" in otr.to_text(tree, feature_names=["x", "velocity"])
    assert tree.compose(np.ones((2, 2)), np.zeros(2)).feature_names is None
    one_output = tree.replace(M=tree.M[:, :1], c=tree.c[:, :1])
    assert (one_output.feature_names, one_output.output_names) == (("position", "speed"), None)
    assert tree.replace(feature_names=None).feature_names is None
    otr.save(plain, tmp_path / "plain")
    assert "names" not in (tmp_path / "plain.json").read_text()
    for wrong in (["one"], ["one", 2]):
        with pytest.raises(otr.InvalidTreeError, match=r"feature_names is .*, expected 2 texts"):
            plain.replace(feature_names=wrong)
