"""Ranges and conditions against dense sampling and worked examples."""

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.proof.certificate import Sum
from otr.proof.head_bounds import tanh_line
from otr.proof.properties import check_verdict
from otr.proof.verdict import Condition, Inequality
from tests.core.strategies import cases, make_network

BOX = (-1.5, 2.0)


def grid(n_inputs: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(*BOX, (4000, n_inputs))


@settings(max_examples=60)
@given(cases(heads=("identity", "clip_box", "tanh_box"), max_layers=3))
def test_no_state_is_outside_the_range_and_its_ends_are_taken(case) -> None:
    network = case.network
    tree = otr.map_network(network)
    found = otr.output_range(tree, BOX)
    answers = network.predict(grid(network.n_inputs))
    assert (answers >= found.low - 1e-9).all() and (answers <= found.high + 1e-9).all()
    for output in range(network.n_outputs):
        for states, values in ((found.low_states, found.low), (found.high_states, found.high)):
            assert (states[output] >= BOX[0] - 1e-9).all() and (states[output] <= BOX[1] + 1e-9).all()
            # A network is continuous, so that the end is taken, not only approached.
            assert network.predict(states[output])[output] == pytest.approx(values[output], abs=1e-6)


def test_a_worked_range() -> None:
    network = otr.ReluNetwork([[[1.0, 0.0], [0.0, 1.0]], [[1.0, -2.0]]], [[0.0, -1.0], [0.5]])
    found = otr.output_range(otr.map_network(network), ([-1.0, 0.0], [3.0, 2.0]))
    assert (found.low.tolist(), found.high.tolist()) == ([-1.5], [3.5])
    tree = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], [[[0.0]], [[1.0]]], [[5.0], [1.0]])
    jump = otr.output_range(tree, (-1.0, 1.0))
    assert (jump.low.tolist(), jump.high.tolist()) == ([1.0], [5.0])
    assert otr.output_range(tree, (0.5, 1.0)).low.tolist() == [1.5]
    far = otr.output_range(one_leaf(), ([1e16], [1e16 + 20]))  # boxes in which floats find no ball
    assert (far.low.tolist(), far.high.tolist()) == ([1e16], [1e16 + 20])
    step = otr.output_range(otr.parse_program("if x <= 1: 5 else: 7", ["x"]), ([1.0], [np.nextafter(1, 2)]))
    assert (step.low.tolist(), step.high.tolist()) == ([5], [7])
    e, M = 1e-9, np.zeros((3, 1, 2))
    M[1, 0] = [1.0, -1.0]
    thin = otr.ObliqueTree([~0, ~1], [1, ~2], [[1.0, 0.0], [1.0, -e]], [0.0, -e / 2], M, [[0.0], [1000.0], [0.0]])
    assert thin.predict([0.1 * e, 0.0])[0] >= 1000.0
    assert otr.output_range(thin, (-1.0, 1.0)).high.tolist() == pytest.approx([1001.0])


def test_labels_that_a_box_can_bring() -> None:
    network = otr.ReluNetwork([[[1.0], [-1.0], [0.0]]], [[0.0, 0.0, 0.5]], head=otr.Argmax())
    tree = otr.map_network(network)
    assert otr.reachable_labels(tree, (-2.0, 2.0)).tolist() == [0, 1, 2]
    assert otr.reachable_labels(tree, (-0.4, 0.4)).tolist() == [2]
    assert otr.reachable_labels(tree).tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="use reachable_labels"):
        otr.output_range(tree, (-1.0, 1.0))
    with pytest.raises(ValueError, match="use output_range"):
        otr.reachable_labels(otr.map_network(otr.ReluNetwork([[[1.0]]], [[0.0]])))


@settings(max_examples=30)
@given(cases(max_layers=2), st.integers(0, 2**32 - 1), st.floats(-2.0, 2.0, allow_subnormal=False))
def test_a_verdict_agrees_with_every_state(case, seed: int, slack: float) -> None:
    network, rng = case.network, np.random.default_rng(seed)
    tree = otr.map_network(network)
    X = grid(network.n_inputs, 1)
    answers = network.predict(X)
    if isinstance(network.head, otr.Sign):
        answers = answers[:, None]
    elif tree.labels is not None:
        answers = np.eye(network.n_outputs)[answers]
    w, u = rng.normal(size=network.n_inputs), rng.normal(size=network.n_outputs)
    values = X @ w + answers @ u
    condition = Condition(w, u, float(values.max() + slack * values.std() / 10))
    verdict = otr.find_violation(tree, condition, BOX)
    check_verdict(verdict, tree, condition, BOX)
    if verdict.holds:
        assert values.max() <= max(condition.bound, verdict.value) + 1e-6
        assert verdict.state is verdict.point is None
        assert {piece.leaf for piece in verdict.pieces} == set(range(tree.n_leaves))
    else:
        assert verdict.value > condition.bound
        x = verdict.state
        assert (x >= BOX[0] - 1e-9).all() and (x <= BOX[1] + 1e-9).all()
        if verdict.point == tuple(map(Fraction, x)):  # else float64 is too coarse for a state that fails
            assert w @ x + verdict.action @ u == pytest.approx(verdict.value, rel=1e-9, abs=1e-9)
        np.testing.assert_allclose(tree.predict(x) if tree.labels is None else verdict.action, verdict.action)
    if values.max() > condition.bound + 1e-6:
        assert not verdict.holds


def test_the_value_is_of_the_answer_beside_it() -> None:
    """At (1, 1), where the condition is largest, the test is positive but rounds to 0: the labels differ."""
    tree = otr.ObliqueTree(
        [~0], [~1], [[1.0, 1e-17]], [-1.0], [[[0.0] * 2]] * 2, [[0.0]] * 2, labels=[0, 1], head=otr.Sign()
    )
    w, u, box = np.array([1.0, 1.0]), np.array([0.5]), (-1.0, 1.0)
    assert tree.predict([1.0, 1.0]) == 0
    verdict = otr.find_violation(tree, Condition(w, u, 0.0), box)
    check_verdict(verdict, tree, Condition(w, u, 0.0), box)
    assert verdict.point == tuple(map(Fraction, verdict.state))
    assert w @ verdict.state + verdict.action @ u == pytest.approx(verdict.value, abs=1e-9)


def test_the_largest_value_is_found_to_the_tolerance() -> None:
    """On one affine leaf under tanh, the maximum of tanh(3 x) - x on [0, 2] is where tanh' = 1/3."""
    tree = otr.map_network(otr.ReluNetwork([[[3.0]]], [[0.0]], head=otr.TanhBox(-1.0, 1.0)))
    best = np.arccosh(np.sqrt(3.0)) / 3
    largest = np.tanh(3 * best) - best
    holds = otr.find_violation(tree, Condition([-1.0], [1.0], largest + 1e-4), (0.0, 2.0))
    assert holds.holds and largest <= holds.value <= largest + 1e-4 + 1e-11
    fails = otr.find_violation(tree, Condition([-1.0], [1.0], largest - 1e-4), (0.0, 2.0))
    assert not fails.holds and largest - 1e-4 < fails.value <= largest


@given(st.floats(-8, 8, allow_subnormal=False), st.floats(0, 8, allow_subnormal=False), st.integers(0, 100))
def test_lines_lie_above_tanh(low: float, width: float, share: int) -> None:
    slope, offset = tanh_line(np.array([low]), np.array([low + width]))
    y = low + width * share / 100
    assert slope[0] * y + offset[0] >= np.tanh(y) - 1e-12
    assert slope[0] * y + offset[0] <= np.tanh(y) + 2 * width + 1e-12


@pytest.mark.parametrize("head", ["clip_box", "tanh_box", "argmax"])
def test_a_proof_that_was_tampered_with_is_refused(head: str) -> None:
    tree = otr.map_network(make_network(np.random.default_rng(7), (3,), n_inputs=2, n_outputs=2, head=head))
    condition = Condition([0.3, -0.2], [1.0, 0.5], 1.95)
    verdict = otr.find_violation(tree, condition, BOX)
    assert verdict.holds
    check_verdict(verdict, tree, condition, BOX)
    proofs = [() if piece.is_empty else piece.proof.multipliers for piece in verdict.pieces]
    at = next(i for i, multipliers in enumerate(proofs) if max(multipliers, default=0) > 0.01)
    piece, rows, multipliers = verdict.pieces[at], verdict.pieces[at].proof.rows, proofs[at]

    def with_piece(*others: Inequality) -> object:
        return replace(verdict, pieces=(*verdict.pieces[:at], *others, *verdict.pieces[at + 1 :]))

    lies = [
        with_piece(),
        with_piece(replace(piece, proof=Sum(rows, tuple(-m for m in multipliers)))),
        with_piece(replace(piece, proof=Sum(rows, tuple(1000 * m for m in multipliers)))),
        with_piece(replace(piece, proof=Sum(tuple("test 999" for _ in rows), multipliers))),
        with_piece(replace(piece, is_empty=True)),
        replace(verdict, holds=False, state=np.zeros(2), point=(Fraction(0), Fraction(0)), leaf=0),
    ]
    if piece.lines:
        slope, offset = piece.lines[0]
        lines = [(slope, offset - 0.1), (0.5 * slope - 0.1, offset), (np.nan, offset), (slope, -np.inf)]
        lies += [with_piece(replace(piece, lines=(line, *piece.lines[1:]))) for line in lines]
    for lie in lies:
        with pytest.raises(otr.CertificateError, match=r"^leaf \d+:"):
            check_verdict(lie, tree, condition, BOX)
    with pytest.raises(otr.CertificateError, match=r"^leaf \d+:"):
        check_verdict(verdict, tree, replace(condition, bound=verdict.value - 0.05), BOX)


@pytest.mark.parametrize(
    ("text", "box"),
    [
        ("if x == 0: 5 else: max(x, 0)", (-1.0, 1.0)),
        ("if x > 0.5 and x <= 0.502: 5 else: 0 * x", (-1e6, 1e6)),
        ("if x >= 1: 5 else: x", (-1.0, 1.0)),
    ],
)
def test_a_leaf_of_a_single_point_counts(text: str, box: tuple[float, float]) -> None:
    tree = otr.parse_program(text, ["x"])
    assert otr.output_range(tree, box).high.tolist() == [5.0]
    verdict = otr.find_violation(tree, Condition([0.0], [1.0], 4.0), box)
    assert (verdict.holds, verdict.value) == (False, 5.0)
    assert tree.predict(verdict.state).tolist() == [5.0]
    check_verdict(verdict, tree, Condition([0.0], [1.0], 4.0), box)
    labelled = tree.replace(labels=(tree.c[:, 0] == 5).astype(int), head=otr.Sign())
    assert otr.reachable_labels(labelled, box).tolist() == [0, 1]
    touches, condition = otr.parse_program("if x > 1: 5 else: x", ["x"]), Condition([0.0], [1.0], 1.0)
    assert otr.output_range(touches, (-1.0, 1.0)).high.tolist() == [1.0]
    verdict = otr.find_violation(touches, condition, (-1.0, 1.0))
    assert (verdict.holds, verdict.value) == (True, 1.0)
    check_verdict(verdict, touches, condition, (-1.0, 1.0))


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from(("sign", "argmax", "clip_box", "identity")), st.booleans())
def test_a_state_that_fails_does_so_under_the_tree_s_own_answer(seed: int, head: str, exact: bool) -> None:
    rng = np.random.default_rng(seed)
    n_outputs = 1 if head == "sign" else 3
    network = make_network(rng, (3, 2), n_inputs=2, n_outputs=n_outputs, head=head, exact=exact)
    tree, w, u = otr.minimal_tree(network, BOX), rng.normal(size=2), rng.normal(size=n_outputs)
    X = grid(2, 1)
    answers = tree.predict(X)
    if tree.labels is not None:
        answers = answers[:, None] if head == "sign" else np.eye(3)[answers]
    condition = Condition(w, u, float(np.quantile(X @ w + answers @ u, 0.9)))
    verdict = otr.find_violation(tree, condition, BOX)
    check_verdict(verdict, tree, condition, BOX)
    assert not verdict.holds
    answer = tree.predict(verdict.state)
    if tree.labels is not None:
        answer = np.array([answer]) if head == "sign" else np.eye(3)[answer]
    assert w @ verdict.state + answer @ u > condition.bound


@settings(max_examples=60)
@given(cases(heads=("identity", "clip_box"), max_layers=2), st.data())
def test_a_condition_is_asked_of_what_is_given_alone(case, data) -> None:
    tree, d = otr.map_network(case.network), case.network.n_inputs
    numbers = st.integers(-2, 2).map(float)
    normals = st.lists(numbers, min_size=d, max_size=d)
    half_spaces = data.draw(st.lists(st.builds(otr.HalfSpace, normals, numbers, st.booleans()), min_size=1, max_size=3))
    action = np.eye(tree.n_outputs)[0]
    condition = Condition(np.zeros(d), action, data.draw(numbers), tuple(half_spaces))
    verdict = otr.find_violation(tree, condition, BOX)
    check_verdict(verdict, tree, condition, BOX)
    X = grid(d)
    inside = np.all([(X @ np.array(each.P) + each.v > 0) == each.is_above for each in half_spaces], axis=0)
    if verdict.holds:
        assert tree.predict(X)[inside, 0].max(initial=-np.inf) <= verdict.value + 1e-9 <= condition.bound + 1e-9
    else:
        values = [sum(Fraction(a) * x for a, x in zip(each.P, verdict.point, strict=True)) + Fraction(each.v)
                  for each in half_spaces]  # fmt: skip
        assert [value > 0 for value in values] == [each.is_above for each in half_spaces]
        assert verdict.action[0] > condition.bound - 1e-9 and verdict.leaf < tree.n_leaves


def test_the_side_of_what_is_given_is_exact() -> None:
    tree = otr.parse_program("if a > 1: b else: 5", ["a", "b"])
    above, closed = (otr.HalfSpace([sign, 0.0], -sign, sign > 0) for sign in (1.0, -1.0))  # a > 1, and a >= 1
    condition = Condition([0.0, 0.0], [1.0], 2.0)
    assert otr.find_violation(tree, replace(condition, given=(above,)), BOX).holds
    verdict = otr.find_violation(tree, replace(condition, given=(closed,)), BOX)
    assert not verdict.holds and verdict.point[0] == 1
    nowhere = replace(condition, given=(above, otr.HalfSpace([1.0, 0.0], -1.0, False)))
    outside = replace(condition, given=(otr.HalfSpace([1.0, 0.0], -5.0, True),))
    assert otr.find_violation(tree, nowhere, BOX).holds and otr.find_violation(tree, outside, BOX).holds
    # No bound of a piece without states is reported.
    tree = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], np.zeros((2, 1, 1)), [[1.0], [50.0]])
    condition = Condition([0.0], [1.0], 100.0, (otr.HalfSpace([1.0], 0.0, False),))
    verdict = otr.find_violation(tree, condition, (-1.0, 1.0))
    check_verdict(verdict, tree, condition, (-1.0, 1.0))
    assert (verdict.holds, verdict.value, verdict.leaf) == (True, 1.0, 0)


@settings(max_examples=40)
@given(cases(heads=("exp",), max_layers=2), st.integers(0, 2**32 - 1))
def test_expected_counts_are_bounded(case, seed: int) -> None:
    network = case.network
    if np.abs(network.forward(grid(network.n_inputs))).max() > 20:  # beyond what a bound can be told to 1e-6
        return
    tree, rng = otr.map_network(network), np.random.default_rng(seed)
    counts = network.predict(grid(network.n_inputs))
    weights = rng.choice([-1.0, 1.0], network.n_outputs)
    reached = float((counts @ weights).max())
    above = Condition(np.zeros(network.n_inputs), weights, reached + abs(reached) / 2 + 1e-3)
    verdict = otr.find_violation(tree, above, BOX, tolerance=1e-6 * (1 + abs(reached)))
    check_verdict(verdict, tree, above, BOX)
    if not verdict.holds:
        assert verdict.state is not None and network.predict(verdict.state) @ weights > above.bound
    below = replace(above, bound=reached - 1e-3 * (1 + abs(reached)))
    found = otr.find_violation(tree, below, BOX)
    assert not found.holds and found.state is not None
    assert network.predict(found.state) @ weights > below.bound


def one_leaf(head: otr.Head | None = None, w: float = 1.0) -> otr.ObliqueTree:
    return otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[w]]], [[0.0]], head=head)


def test_a_verdict_is_checked_to_its_last_number() -> None:
    tree, box = otr.parse_program("if x <= 0: -1 else: 2 * x", ["x"]), ([-1.0], [1.0])
    kept, failing = otr.Condition([0.0], [1.0], 3.0), otr.Condition([0.0], [1.0], 1.0)
    verdict = otr.find_violation(tree, kept, box)
    check_verdict(verdict, tree, kept, box)
    piece, *others = verdict.pieces
    for changes in (
        {"value": verdict.value - 1},
        {"value": np.nan},
        {"tolerance": np.nan},
        {"pieces": (replace(piece, low=()), *others)},
        {"pieces": (replace(piece, lines=()), *others)},
    ):
        with pytest.raises(otr.CertificateError):
            check_verdict(replace(verdict, **changes), tree, kept, box)
    found = otr.find_violation(tree, failing, box)
    check_verdict(found, tree, failing, box)
    for changes in ({"state": np.array([-0.5])}, {"action": np.array([3.0])}, {"value": 1.5}, {"action": None}):
        with pytest.raises(otr.CertificateError, match="another state, action or value"):
            check_verdict(replace(found, **changes), tree, failing, box)


def test_a_line_that_is_below_tanh_between_its_ends_is_refused() -> None:
    tree, condition, box = one_leaf(otr.TanhBox(-1.0, 1.0), 1e17), otr.Condition([-1.0], [1.0], 0.1), ([0.0], [1.0])
    verdict = otr.find_violation(tree, condition, box)
    assert not verdict.holds
    flat = Inequality(0, (-5e-324,), (1.0000000000000002e17,), ((1.0000001e-17, 0.0),), Sum((), ()), is_empty=False)
    forged = replace(verdict, holds=True, value=0.05, state=None, action=None, point=None, pieces=(flat,))
    with pytest.raises(otr.CertificateError, match="a line of a piece is below"):
        check_verdict(forged, tree, condition, box)


def test_a_reported_bound_is_itself_kept() -> None:
    for high in np.random.default_rng(0).uniform(0.1, 1.0, 50):
        found = otr.find_violation(one_leaf(), Condition([0.1], [0.0], 1.0), (-high, high))
        assert otr.find_violation(one_leaf(), Condition([0.1], [0.0], found.value), (-high, high)).holds
        assert Fraction(found.value) >= Fraction(0.1) * Fraction(high)


PLAIN = otr.map_network(make_network(np.random.default_rng(0), (3,), n_inputs=2, n_outputs=1))
STEP = otr.ObliqueTree([~0], [~1], [[1.0, 0.0]], [0.0], np.zeros((2, 1, 2)), [[0.0], [1.0]])
STEEP = otr.ObliqueTree([~0], [~1], [[1.0]], [-0.1], [[[1000.0]], [[0.0]]], [[0.0], [0.0]], head=otr.Exp())
FAR_TANH, TANH = one_leaf(otr.TanhBox(1e6, 1e6 + 1)), one_leaf(otr.TanhBox(-1.0, 1.0))


def violation(
    tree: otr.ObliqueTree, state: list, action: list, bound: float, *given: otr.HalfSpace, **more: float
) -> None:
    otr.find_violation(tree, Condition(state, action, bound, given), BOX, **more)


@pytest.mark.parametrize(
    ("error", "words", "ask"),
    [
        (ValueError, "expected a bounded box", lambda: otr.output_range(PLAIN, ([0.0, 0.0], [1.0, np.inf]))),
        (ValueError, "nearer than float64 resolves", lambda: otr.output_range(one_leaf(), ([0.0], [5e-324]))),
        (
            TypeError,
            "expected an ObliqueTree",
            lambda: otr.output_range(otr.ReluNetwork([[[1.0]]], [[0.0]]), BOX),
        ),
        (ValueError, r"expected \(2,\) of the state and \(1,\) of the", lambda: violation(PLAIN, [1], [1], 0.0)),
        (otr.OtrError, "more than 3 pieces", lambda: violation(PLAIN, [1, 0], [1], 1e9, max_pieces=3)),
        (ValueError, "no finite number", lambda: violation(one_leaf(), [0], [np.nan], 2.0)),
        (ValueError, "no finite number", lambda: violation(one_leaf(), [0], [1], np.nan)),
        (ValueError, "no finite number", lambda: violation(one_leaf(), [np.inf], [1], 2.0)),
        (ValueError, "tolerance is", lambda: violation(PLAIN, [0, 0], [1], 0.5, tolerance=-1.0)),
        (ValueError, "tolerance is", lambda: violation(PLAIN, [0, 0], [1], 0.5, tolerance=np.nan)),
        (ValueError, "is none of the 1 outputs", lambda: violation(STEP.replace(labels=[0, 7]), [0, 0], [1], 0.5)),
        (ValueError, "is none of the 1 outputs", lambda: violation(STEP.replace(labels=[0, -1]), [0, 0], [1], 0.5)),
        (
            ValueError,
            r"P of shape \(1,\), exp",
            lambda: violation(PLAIN, [0, 0], [1], 0.5, otr.HalfSpace([1.0], 0.0, True)),
        ),
        (otr.OtrError, "may reach 2000, .* ask about a smaller box", lambda: violation(STEEP, [0], [1], 1e50)),
        (
            otr.OtrError,
            "rounding hides which",
            lambda: violation(FAR_TANH, [0], [1], 1e6 + 0.999),
        ),
        (otr.OtrError, "rounding hides which", lambda: violation(TANH, [0], [1], float(np.tanh(2)), tolerance=0.0)),
    ],
)
def test_what_has_no_answer_is_refused(error: type[Exception], words: str, ask: Callable[[], None]) -> None:
    with pytest.raises(error, match=words):
        ask()
