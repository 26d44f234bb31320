"""`explain`: margins, shares and nearest states are what a search through all leaves finds."""

import json
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import otr
from otr.core.heads import HEADS
from otr.explanation.nearest import CLEAR
from otr.geometry.regions import leaf_paths
from tests.core.strategies import make_network, worked_network
from tests.core.test_head import KNOWN
from tests.core.test_tree import random_tree


def shortest(G: NDArray, h: NDArray) -> float:
    """The least norm of z with ``G z >= h``, by every set of rows that may bind; inf where there is no z."""
    best = 0.0 if (h <= 0).all() else np.inf
    for k in range(1, G.shape[1] + 1):
        rows = np.array(list(combinations(range(len(G)), k)), dtype=int).reshape(-1, k)
        z = np.einsum("nij,nj->ni", np.linalg.pinv(G[rows]), h[rows])
        feasible = (z @ G.T >= h - CLEAR / 4).all(axis=1)
        best = min(best, np.linalg.norm(z[feasible], axis=1).min(initial=np.inf))
    return best


def pieces(tree: otr.ObliqueTree) -> list[tuple[int, int | None, NDArray, NDArray]]:
    """Every leaf with each label that it may have: leaf, label, rows [P | v] of at least 0 there, which are above."""
    made: list[tuple[int, int | None, NDArray, NDArray]] = []
    for leaf, (nodes, signs) in enumerate(zip(*leaf_paths(tree), strict=True)):
        rows = (tree.test_forms[nodes] * signs[:, None])[signs != 0]
        forms = tree.leaf_forms[leaf]
        if tree.labels is not None or not tree.head.gives_labels:
            made.append((leaf, None if tree.labels is None else int(tree.labels[leaf]), rows, signs[signs != 0] > 0))
            continue
        for label in range(tree.head.n_labels(tree.n_outputs)):
            won = forms * (1 if label else -1) if len(forms) == 1 else forms[label] - np.delete(forms, label, axis=0)
            strict = [label == 1] if len(forms) == 1 else np.arange(len(won)) < label
            made.append((leaf, label, np.vstack((rows, won)), np.append(signs[signs != 0] > 0, strict)))
    return made


def least_distances(
    tree: otr.ObliqueTree, x: NDArray, leaf: int, label: int | None, scales: NDArray, box: tuple[NDArray, NDArray]
) -> tuple[float, float]:
    """The distance of another leaf and, if there is one, of another label."""
    clear = CLEAR * (1 + np.abs(x / scales).max())
    eye = np.eye(len(x))
    sides = np.concatenate((eye, -eye)), np.concatenate(((box[0] - x) / scales, (x - box[1]) / scales))
    bounded = np.isfinite(sides[1])
    found = [np.inf, np.inf]
    for its_leaf, its_label, rows, strict in pieces(tree):
        normals, values = rows[:, :-1] * scales, rows[:, :-1] @ x + rows[:, -1]
        lengths = np.linalg.norm(normals, axis=1)
        constant = lengths == 0
        if (values[constant] < 0).any() or (values[constant & strict] == 0).any() or not len(rows):
            continue
        G, h = (array[lengths > 0] for array in (normals, clear * lengths - values))
        G, h = G / lengths[lengths > 0, None], h / lengths[lengths > 0]
        distance = shortest(np.vstack((G, sides[0][bounded])), np.append(h, sides[1][bounded]))
        for i, other in enumerate((its_leaf != leaf, its_label != label)):
            found[i] = min(found[i], distance if other else np.inf)
    return found[0], found[1]


@st.composite
def questions(draw: st.DrawFn) -> tuple[otr.ObliqueTree, NDArray, NDArray, tuple[NDArray, NDArray]]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    d, exact = draw(st.integers(1, 3)), draw(st.booleans())
    head = draw(st.sampled_from(("identity", "sign", "argmax")))
    n_outputs = 1 if head == "sign" else draw(st.integers(2, 3))
    if draw(st.booleans()):
        tree = random_tree(rng, draw(st.integers(1, 9)), d, n_outputs, 5).replace(head=KNOWN[head][0])
    else:
        widths = tuple(draw(st.lists(st.integers(1, 2), max_size=2)))
        tree = otr.map_network(
            make_network(rng, widths, n_inputs=d, n_outputs=n_outputs, head=head, exact=exact, dense="input")
        )
    x = rng.integers(-2, 3, d).astype(float) if exact else rng.normal(size=d)
    scales = draw(st.sampled_from((np.ones(d), rng.uniform(0.5, 2, d))))
    none = np.full(d, np.inf)
    box = draw(st.sampled_from(((-none, none), (x - rng.uniform(0, 1, d), x + rng.uniform(0.1, 1, d)))))
    return tree, x, scales, box


@given(questions())
def test_no_state_nearer_has_another_leaf_or_label(
    question: tuple[otr.ObliqueTree, NDArray, NDArray, tuple[NDArray, NDArray]],
) -> None:
    tree, x, scales, box = question
    explained = otr.explain(tree, x, scales=scales, domain=box)
    is_label = np.ndim(explained.answer) == 0
    label = int(explained.answer) if is_label else None
    for found, expected in zip(
        (explained.nearest_leaf, explained.nearest_label),
        least_distances(tree, x, explained.leaf, label, scales, box),
        strict=True,
    ):
        if found is None:
            assert expected > 1e4 or (found is explained.nearest_label and not is_label)
            continue
        assert found.distance == pytest.approx(expected, rel=1e-6, abs=1e-7)
        assert found.distance == pytest.approx(np.linalg.norm((found.state - x) / scales), rel=1e-9)
        assert found.leaf == tree.apply(found.state)
        np.testing.assert_array_equal(found.answer, tree.predict(found.state))
        assert (box[0] <= found.state).all() and (found.state <= box[1]).all()
    if explained.nearest_leaf is not None:
        assert explained.nearest_leaf.leaf != explained.leaf
    if explained.nearest_label is not None:
        assert explained.nearest_label.answer != explained.answer


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(set(KNOWN) - {"pid_box", "exp"})))
def test_a_pattern_tree_with_all_paths_is_explained_as_its_tree(seed: int, head: str) -> None:
    rng = np.random.default_rng(seed)
    n_outputs = KNOWN[head][1]
    net = make_network(rng, (3, 2), n_inputs=2, n_outputs=n_outputs, head=head)
    patterns, tree, x = otr.PatternTree(net), otr.map_network(net), rng.normal(size=2)
    of_patterns, of_tree = otr.explain(patterns, x), otr.explain(tree, x)
    assert of_patterns.leaf == of_tree.leaf == tree.apply(x)
    np.testing.assert_allclose([t.margin for t in of_patterns.tests], [t.margin for t in of_tree.tests], atol=1e-12)
    np.testing.assert_allclose(of_patterns.shares, of_tree.shares, atol=1e-12)
    for one, other in (
        (of_patterns.nearest_leaf, of_tree.nearest_leaf),
        (of_patterns.nearest_label, of_tree.nearest_label),
    ):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            np.testing.assert_allclose(one.state, other.state, atol=1e-9)
            assert one.leaf == other.leaf
    restricted = otr.PatternTree(net).observe(rng.normal(size=(20, 2))).observed()
    assert otr.explain(restricted, x).leaf == restricted.to_tree().apply(x)


@pytest.mark.parametrize("name", sorted(HEADS))
def test_tests_and_shares_add_up_under_every_head(name: str) -> None:
    rng = np.random.default_rng(0)
    tree = random_tree(rng, 9, 3, KNOWN[name][1], 8).replace(head=KNOWN[name][0])
    for x in rng.normal(size=(20, 3)):
        explained = otr.explain(tree, x)
        leaf, nodes = int(tree.apply(x)), tree.decision_path(x).indices
        assert explained.leaf == leaf
        of_tree = [test for test in explained.tests if test.node is not None]
        assert [test.node for test in of_tree] == nodes.tolist()
        np.testing.assert_allclose([t.margin for t in of_tree], tree.P[nodes] @ x + tree.v[nodes], atol=1e-12)
        assert len(explained.tests) == len(nodes) + tree.head.n_tests(tree.n_outputs)
        np.testing.assert_array_equal(explained.shares, tree.M[leaf] * x)
        np.testing.assert_allclose(explained.shares.sum(axis=1) + explained.constants, tree.forward(x), atol=1e-12)
        np.testing.assert_allclose(explained.outputs, tree.forward(x), atol=1e-12)
        np.testing.assert_array_equal(explained.answer, tree.predict(x))
        assert tree.head.words and explained.head == tree.head.in_words(tree.n_outputs)
        json.dumps(explained.to_dict(), allow_nan=False)


def test_a_network_too_wide_for_a_tree_has_its_nearest_label() -> None:
    rng = np.random.default_rng(1)
    net = make_network(rng, (32, 32), n_inputs=3, n_outputs=3, head="argmax")
    x = np.zeros(3)
    explained = otr.explain(otr.PatternTree(net), x)
    assert len(explained.tests) == 66
    for found in (explained.nearest_leaf, explained.nearest_label):
        assert found is not None
        step = rng.normal(size=(20_000, 3))
        nearer = step / np.linalg.norm(step, axis=1)[:, None] * found.distance * rng.uniform(size=(20_000, 1))
        paths = otr.PatternTree(net).paths(np.vstack((x, nearer)))
        same = paths[1:] == paths[0] if found is explained.nearest_leaf else net.predict(nearer) == explained.answer
        assert same.all()
    assert explained.nearest_label is not None and net.predict(explained.nearest_label.state) != explained.answer
    with pytest.raises(otr.TimeLimitError, match="the nearest states of another leaf and label were not found"):
        otr.explain(otr.PatternTree(net), x, max_seconds=0)


def test_what_is_printed() -> None:
    tree = otr.map_network(worked_network()).replace(head=otr.ClipBox(-1, 3))
    assert str(otr.explain(tree, [0.5, -0.5], feature_names=["angle", "rate"], output_names=["torque"])) == (
        "leaf 1: torque = 3\n"
        "  -0.4 - 2.7 angle - 0.8 rate <= 0: yes, -1.35\n"
        "  0.6 + 0.2 angle + 2 rate <= 0: yes, -0.3\n"
        "  1.2 + angle - 0.1 rate <= 0: no, 1.75\n"
        "torque = 3.5, the sum of\n"
        "  +0.6  angle (1.2 times 0.5)\n"
        "  +0.06  rate (-0.12 times -0.5)\n"
        "  +2.84  constant\n"
        "head: clipped to -1 .. 3\n"
        "nearest state of another leaf, 0.1493 away: rate -0.5 -> -0.3515, angle 0.5 -> 0.5149\n"
        "  leaf 3: torque = 3"
    )


def test_scores_are_printed_where_the_head_decides_and_where_the_tests_do() -> None:
    net = otr.ReluNetwork([[[1.0], [2.0]]], [[1.0, 0.0]], head=otr.Argmax())
    of_network = otr.map_network(net)
    of_leaf = otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[1.0], [2.0]]], [[1.0, 0.0]], head=otr.Argmax())
    for tree, head in (
        (of_network, "the tests decide the label"),
        (of_leaf, "the label of the largest output, the first of equals"),
    ):
        assert str(otr.explain(tree, [3.0], output_names=["go", "stop"])).splitlines()[1:8] == [
            "  -1 + x0 <= 0: no, 2", "go = 4, the sum of", "  +3  x0 (1 times 3)", "  +1  constant",
            "stop = 6, the sum of", "  +6  x0 (2 times 3)", "  +0  constant",
        ]  # fmt: skip
        shown = str(otr.explain(tree, [3.0]))
        assert f"\nhead: {head}\n" in shown and "\ny1 = 6, the sum of\n" in shown
        assert "\nnearest state of another label, 2 away: x0 3 -> 1\n" in shown


def test_wide_states_are_printed_by_their_largest_terms() -> None:
    net = make_network(np.random.default_rng(0), (1,), n_inputs=100, n_outputs=1)
    shown = str(otr.explain(otr.map_network(net), np.ones(100))).splitlines()
    assert " + 92 more terms <= 0: " in shown[1] and max(map(len, shown)) < 250
    assert sum(line.endswith("  92 more inputs") for line in shown) == 1 and len(shown) == 16


def test_a_tree_that_has_one_answer_has_no_nearest_other() -> None:
    leaf = otr.map_network(otr.ReluNetwork([[[1.0, 2.0]]], [[3.0]]))
    explained = otr.explain(leaf, [1.0, 1.0])
    assert explained.nearest_leaf is None and explained.tests == () and explained.outputs.tolist() == [6.0]
    tree = otr.parse_program("if x <= 1: 0 else: 1", ["x"], labels=True)
    assert otr.explain(tree, [0.0]).nearest_label is not None
    assert otr.explain(tree, [0.0], domain=([-1.0], [0.5])).nearest_label is None


@pytest.mark.parametrize(
    ("x", "options", "message"),
    [
        ([[0.0, 0.0]], {}, r"x has shape \(1, 2\), or a number that is not finite; expected one state \(2,\)"),
        ([0.0, np.nan], {}, "or a number that is not finite"),
        ([0.0], {}, "states have shape"),
        ([0.0, 2.0], {"domain": ([-1, -1], [1, 1])}, r"x is \[0.0, 2.0\], which is not in the domain"),
        ([0.0, 0.0], {"scales": [1.0, 0.0]}, r"scales are \[1.0, 0.0\], expected 2 finite numbers above 0"),
    ],
)
def test_what_cannot_be_explained_is_said(x: list[float], options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        otr.explain(otr.map_network(worked_network()), x, **options)


def test_a_network_is_no_tree() -> None:
    with pytest.raises(TypeError, match="tree is a ReluNetwork, expected an ObliqueTree"):
        otr.explain(worked_network(), [0.0, 0.0])  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="tree is a ReluNetwork, expected an ObliqueTree"):
        otr.importance(worked_network(), [[0.0, 0.0]])  # type: ignore[arg-type]
