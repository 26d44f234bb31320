import numpy as np
import pytest
from hypothesis import given

import otr
from otr.core import pattern_tree
from tests.core.strategies import Case, assert_same_answers, cases, make_network, worked_network


def all_paths(n_bits: int) -> np.ndarray:
    return (np.arange(2**n_bits)[:, None] >> np.arange(n_bits - 1, -1, -1)) & 1 == 1


@given(cases())
def test_all_paths_listed_give_the_mapped_tree_and_unrestricted_it_is_the_network(case: Case) -> None:
    full = otr.PatternTree(case.network)
    assert_same_answers(full.predict(case.states), case.network.predict(case.states), case.network, case)
    np.testing.assert_array_equal(full.forward(case.states), case.network.forward(case.states))
    listed = otr.PatternTree(case.network, all_paths(full.n_bits)).to_tree()
    mapped = otr.map_network(case.network)
    for name in ("children_left", "children_right", "labels"):
        np.testing.assert_array_equal(getattr(listed, name), getattr(mapped, name))
    for name in ("P", "v", "M", "c"):
        np.testing.assert_allclose(getattr(listed, name), getattr(mapped, name), rtol=1e-9, atol=1e-9)


@given(cases())
def test_observed_paths_are_counted(case: Case) -> None:
    tree = otr.PatternTree(case.network)
    for half in np.array_split(case.states, 2):
        assert tree.observe(half) is tree
    rows, counts = np.unique(tree.paths(case.states), axis=0, return_counts=True)
    np.testing.assert_array_equal(tree.patterns, rows)
    np.testing.assert_array_equal(tree.counts, counts)
    assert tree.n_paths == 2**tree.n_bits
    seen = tree.observed()
    assert seen.n_paths == len(rows)
    assert seen.to_tree().n_leaves == len(rows)
    assert tree.n_patterns == seen.n_patterns == len(np.unique(case.network.patterns(case.states), axis=0))


def test_keep_takes_the_most_frequent_and_breaks_ties_by_order() -> None:
    rows = np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=bool)
    tree = otr.PatternTree(worked_network(), rows, [3, 2, 2, 0])
    assert tree.counts.tolist() == [2, 2, 0, 3]  # sorted: 001, 010, 100, 110
    assert tree.keep(2).patterns.astype(int).tolist() == [[0, 0, 1], [1, 1, 0]] and tree.keep(9).n_paths == 3
    one = otr.PatternTree(worked_network()).observe([0.5, -0.5]).keep(1).to_tree()
    np.testing.assert_allclose([*one.M.ravel(), *one.c.ravel()], [1.2, -0.12, 2.84])
    net = make_network(np.random.default_rng(0), (2,), n_outputs=2, head="argmax")
    tree = otr.PatternTree(net, all_paths(3)[:4])  # the head's tests are no part of a pattern
    assert (tree.n_paths, tree.n_patterns, otr.PatternTree(net).n_patterns) == (4, 2, 4)


def test_depth_100_is_never_materialised() -> None:
    rng = np.random.default_rng(0)
    net = make_network(rng, (60, 40), n_inputs=5, n_outputs=3, head="argmax")
    X = rng.normal(size=(2000, 5)) * 0.3
    tree = otr.PatternTree(net).observe(X)
    assert tree.n_paths == 2**102
    rows, counts = np.unique(tree.paths(X), axis=0, return_counts=True)
    np.testing.assert_array_equal(tree.patterns, rows)
    np.testing.assert_array_equal(tree.counts, counts)
    np.testing.assert_array_equal(tree.observed().to_tree().predict(X), net.predict(X))
    with pytest.raises(otr.TreeTooLargeError, match=r"2\*\*102"):
        tree.to_tree()


def test_chunks_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    net = make_network(rng, (5, 4), n_outputs=3, head="argmax", dense="all")
    X = rng.normal(size=(300, 3))
    whole = otr.PatternTree(net).observe(X)
    monkeypatch.setattr(pattern_tree, "_CHUNK_STATES", 7)
    monkeypatch.setattr(pattern_tree, "_CHUNK_BYTES", 1)
    parts = otr.PatternTree(net).observe(X)
    np.testing.assert_array_equal(parts.counts, whole.counts)
    monkeypatch.undo()
    tree = whole.observed().to_tree()
    monkeypatch.setattr(pattern_tree, "_CHUNK_BYTES", 1)
    chunked = parts.observed().to_tree()
    for name in ("P", "v", "M", "c"):
        np.testing.assert_allclose(getattr(chunked, name), getattr(tree, name), rtol=1e-12)


def test_a_restricted_tree_counts_where_states_end() -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 2))
    kept = otr.PatternTree(worked_network()).observe(X).keep(3)
    before = kept.counts
    kept.observe(X)
    np.testing.assert_array_equal(kept.counts - before, np.bincount(kept.to_tree().apply(X), minlength=3))
    np.testing.assert_array_equal(kept.predict(X), kept.to_tree().predict(X))


def test_bad_arguments_are_refused() -> None:
    net, path = worked_network(), [[True, False, True]]
    for call, words in (
        (lambda: otr.PatternTree(net, [[True, False]]), r"shape \(1, 2\).*expected \(k, 3\)"),
        (lambda: otr.PatternTree(net, path * 2), "2 rows of which 1 are distinct"),
        (lambda: otr.PatternTree(net, counts=[1]), "without patterns"),
        (lambda: otr.PatternTree(net, np.zeros((0, 3), dtype=bool)), "k > 0"),
        (lambda: otr.PatternTree(net).observe_paths(np.ones((1, 4), dtype=bool)), r"\(1, 4\).*expected \(n, 3\)"),
        (lambda: otr.PatternTree(net).observe_paths(np.array(path), np.array([-1])), "of at least 0"),
        (lambda: otr.PatternTree(net).keep(1), "call observe"),
        (lambda: otr.PatternTree(net).observe([[0.0, 0.0]]).keep(0), "at least 1"),
        (lambda: otr.PatternTree(net, path).observe_paths(np.ones((1, 3), dtype=bool)), "restricted"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
