"""Simplified trees: never longer, always within what the judge allows; the bound on actions holds everywhere."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.proof.action_difference import largest_difference
from otr.shorten.edits import n_numbers
from tests.core.strategies import cases, make_network

BOX = (-1.0, 1.0)


def states(n_inputs: int, n: int = 2000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(*BOX, (n, n_inputs))


@settings(max_examples=50)
@given(cases(heads=("identity", "clip_box", "tanh_box"), max_layers=2), st.integers(0, 2**32 - 1))
def test_no_two_actions_are_further_apart_than_the_bound(case, seed: int) -> None:
    network, rng = case.network, np.random.default_rng(seed)
    tree = otr.map_network(network)
    other = tree.replace(v=tree.v + 0.1 * rng.normal(size=tree.n_nodes), M=tree.M + 0.1 * rng.normal(size=tree.M.shape))
    X = states(network.n_inputs)
    apart = np.abs(tree.predict(X) - other.predict(X)).max()
    bound = largest_difference(tree, other, BOX)
    assert apart <= bound + 1e-9
    if isinstance(network.head, otr.Identity) and network.n_inputs == 1:
        assert bound <= apart + 0.2  # it is taken somewhere
    assert largest_difference(tree, tree, BOX) <= 1e-9


def test_a_worked_difference() -> None:
    ours = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], [[[1.0]], [[2.0]]], [[0.0], [0.0]])
    theirs = otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[1.0]]], [[0.5]])
    assert largest_difference(ours, theirs, BOX) == pytest.approx(0.5)
    assert largest_difference(ours, theirs, (0.0, 2.0)) == pytest.approx(1.5)
    eight, nine = (theirs.replace(M=[[[0.0]]], c=[[c]], head=otr.TanhBox(-1.0, 1.0)) for c in (8, 9))
    assert largest_difference(eight, nine, BOX) == pytest.approx(np.tanh(9) - np.tanh(8))


def test_slivers_that_a_linear_program_cannot_leave_count() -> None:
    d, e = 20, 0.9e-9
    P = np.zeros((2, d))
    P[:, 0], P[1, 1:] = 1.0, -e
    M = np.zeros((3, 1, d))
    M[1, 0] = -1.0
    tree = otr.ObliqueTree([~0, ~1], [1, ~2], P, [0.0, -0.5 * e * d], M, [[0.0], [1000.0], [0.0]])
    zero = otr.ObliqueTree([], [], np.zeros((0, d)), [], np.zeros((1, 1, d)), [[0.0]])
    x = np.ones(d)
    x[0] = 0.7 * e * d
    assert largest_difference(tree, zero, (-1.0, 1.0)) >= tree.predict(x)[0] > 980


def test_where_rounding_hides_how_wide_a_meeting_is_it_counts() -> None:
    box = (1e9, 1e9 + 2e-6)
    tree = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], np.zeros((2, 1, 1)), [[1.0], [2.0]])
    other = tree.replace(c=[[1.0], [5.0]])
    assert largest_difference(tree, other, box) >= 3.0 and largest_difference(tree, other, (-2.0, -1.0)) == 0.0
    none, one = (tree.replace(labels=[label] * 2, head=otr.Sign()) for label in (0, 1))
    assert largest_difference(none, one, box) == 1.0


def test_labels_differ_somewhere_or_nowhere() -> None:
    network = otr.ReluNetwork([[[1.0], [-1.0]]], [[0.0, 0.0]], head=otr.Argmax())
    tree = otr.map_network(network)
    moved = tree.replace(v=tree.v + 0.5)
    cases_of = ((moved, BOX, 1.0), (tree, BOX, 0.0), (moved, (0.5, 1.0), 0.0))
    assert [largest_difference(tree, other, box) for other, box, _ in cases_of] == [gap for *_, gap in cases_of]
    with pytest.raises(ValueError, match="must be the same"):
        largest_difference(tree, otr.map_network(make_network(np.random.default_rng(0), (2,), n_inputs=1)), BOX)


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1), st.sampled_from(("identity", "clip_box", "tanh_box")), st.sampled_from((0.0, 0.2)))
def test_within_a_bound_on_actions_nothing_changes_by_more(seed: int, head: str, bound: float) -> None:
    network = make_network(np.random.default_rng(seed), (3,), n_inputs=2, head=head)
    tree = otr.minimal_tree(network, BOX)
    simpler = otr.simplify(tree, otr.within(tree, BOX, bound), states(2, 200))
    assert simpler.n_numbers <= simpler.n_numbers_before == n_numbers(tree)
    assert simpler.n_numbers == n_numbers(simpler.tree)
    X = np.concatenate((states(2, 3000, 1), np.array([[a, b] for a in BOX for b in BOX])))
    assert np.abs(simpler.tree.predict(X) - tree.predict(X)).max() <= bound + 1e-9


def test_bang_bang_control_is_found() -> None:
    """Steep leaves, and a test that little but the velocity's sign matters for, as on the mountain car."""
    M, c = [[[0.1, 1.0]], [[-0.1, 2.0]]], [[-3.7], [2.9]]
    tree = otr.ObliqueTree([~0], [~1], [[-0.6, 77.4]], [0.1], M, c, head=otr.TanhBox(-1.0, 1.0))
    X = np.random.default_rng(0).uniform([-1.2, -0.07], [0.6, 0.07], (500, 2))
    wanted = np.where(X[:, 1] > 0, 1.0, -1.0)

    def judge(candidate: otr.ObliqueTree) -> bool:
        return bool(np.abs(candidate.predict(X)[:, 0] - wanted).mean() <= 0.15)

    simpler = otr.simplify(tree, judge, X)
    assert otr.to_text(simpler.tree, feature_names=["x", "v"]) == "if v <= 0 then\n    return -1\nelse\n    return 1\n"
    assert isinstance(simpler.tree.head, otr.Identity)


def test_nothing_is_changed_that_the_judge_refuses() -> None:
    tree = otr.minimal_tree(make_network(np.random.default_rng(1), (4,), n_inputs=2), BOX)
    X = states(2)
    kept = otr.simplify(tree, lambda candidate: False, X)
    assert kept.n_kept == 0 and kept.n_numbers == kept.n_numbers_before
    np.testing.assert_allclose(kept.tree.predict(X), tree.predict(X), atol=1e-12)
    least = otr.simplify(tree, lambda candidate: True, X)
    assert (least.tree.n_leaves, least.n_numbers) == (1, 0)
    step = otr.ObliqueTree([~0], [~1], [[2.9]], [-1.68], np.zeros((2, 1, 1)), [[0.0], [1000.0]])
    kept = otr.simplify(step, lambda candidate: False, [[0.5], [1.58]]).tree
    assert kept.P.tolist() == [[2.9]] and kept.v.tolist() == [-1.68]
    scaled = otr.simplify(step, otr.within(step, (0.0, 60.0), 0.0), [[0.5], [1.58]], refit=False, digits=()).tree
    assert scaled.P.tolist() == [[1.0]]
    far = step.replace(P=[[1e-300]], v=[1e10])
    assert otr.simplify(far, lambda candidate: candidate.c.max() == 1000.0, [[0.5]], digits=()).tree.c.max() == 1000.0
    labelled = otr.minimal_tree(
        make_network(np.random.default_rng(6), (4,), n_inputs=2, n_outputs=3, head="argmax"), BOX
    )
    labels = labelled.predict(X)
    simpler = otr.simplify(labelled, lambda candidate: (candidate.predict(X) == labels).mean() >= 0.97, X)
    assert simpler.n_numbers < simpler.n_numbers_before and (simpler.tree.predict(X) == labels).mean() >= 0.97


def test_leaves_that_differ_beside_a_large_output_stay_two() -> None:
    M = np.zeros((2, 2, 1))
    M[:, 0], M[1, 1] = 1e13, 1.0
    tree = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], M, np.zeros((2, 2)))
    judge = otr.within(tree, (-1.0, 1.0), 0.0)
    kept = otr.simplify(tree, judge, np.linspace(-1, 1, 100)[:, None], refit=False).tree
    assert judge(kept) and kept.predict([0.5]).tolist() == [5e12, 0.5]


def test_bad_requests_are_refused() -> None:
    network = make_network(np.random.default_rng(1), (2,), n_inputs=2)
    tree, X = otr.map_network(network), states(2)

    def simplify(policy: object, X: np.ndarray, **options: object) -> None:
        otr.simplify(policy, lambda candidate: True, X, **options)

    for error, words, ask in (
        (TypeError, "expected an ObliqueTree", lambda: simplify(network, X)),
        (ValueError, "holds no states", lambda: simplify(tree, X[:0])),
        (ValueError, "digits are", lambda: simplify(tree, X, digits=(0,))),
        (ValueError, "not finite", lambda: simplify(tree, np.full((3, 2), np.nan))),
        (ValueError, "bound is", lambda: otr.within(tree, BOX, -0.1)),
        (ValueError, "bound is", lambda: otr.within(tree, BOX, np.nan)),
        (ValueError, "expected a bounded box", lambda: otr.within(tree, None, 0.1)),
    ):
        with pytest.raises(error, match=words):
            ask()


@pytest.mark.parametrize("head", [otr.Argmax(), otr.Sign()])
def test_no_bound_is_promised_of_labels_that_no_test_decides(head: otr.Argmax | otr.Sign) -> None:
    undecided = otr.ObliqueTree([], [], np.zeros((0, 2)), [], [[[1.0, 0.0]]], [[0.0]], head=head)
    decided = otr.map_network(otr.ReluNetwork([[[1.0, 0.0]]], [[0.0]], head=head))
    for ask in (
        lambda: otr.within(undecided, BOX, 0.1),
        lambda: otr.within(decided, BOX, 0.1)(undecided),
        lambda: otr.output_range(undecided, BOX),
        lambda: otr.reachable_labels(undecided, BOX),
    ):
        with pytest.raises(ValueError, match="no test of the tree decides the label"):
            ask()


@pytest.mark.parametrize("high", [1e9, 1e11, 3.4e38])
def test_the_bound_holds_in_a_box_much_wider_than_what_is_visited(high: float) -> None:
    """What is visited may be thinner than any width that float64 knows beside the box's."""
    tree = otr.parse_program("if v <= 0: 0\nelif v <= 5: x\nelse: 0", ["x", "v"])
    box = ([-4.8, -high], [4.8, high])
    X = np.random.default_rng(0).uniform([-4.8, -3], [4.8, 8], (200, 2))
    none = tree.replace(M=0 * tree.M)
    assert largest_difference(tree, none, box) == pytest.approx(4.8)
    simpler = otr.simplify(tree, otr.within(tree, box, 0.1), X).tree
    assert np.abs(simpler.predict(X) - tree.predict(X)).max() <= 0.1 and simpler.n_leaves == 3


def test_tests_that_only_rounding_tells_apart_are_one() -> None:
    tree = otr.parse_program("if 2.9 * x <= 1.68: 0\nelif 3 * x + 7 * y <= 4.9: 500\nelse: 1000", ["x", "y"])
    scaled = tree.replace(P=tree.P / 2.9, v=tree.v / 2.9)
    turned = scaled.replace(
        P=-scaled.P, v=-scaled.v, children_left=tree.children_right, children_right=tree.children_left
    )
    for other in (scaled, turned):
        assert largest_difference(tree, other, (0.0, 60.0)) == 0.0
    moved = tree.v.copy()
    moved[0] *= 1 + 1e-12
    assert largest_difference(tree, tree.replace(v=moved), (0.0, 60.0)) >= 500.0
