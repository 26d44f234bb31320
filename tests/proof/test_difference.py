"""Two trees are equal on a box exactly where no state tells them apart."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr

BOX = (np.array([-2.0, -2.0]), np.array([2.0, 2.0]))
NUMBERS = st.integers(-3, 3).map(float)


@st.composite
def trees(draw, head=None):
    n = draw(st.integers(1, 3))
    W, b, V = ([draw(st.lists(NUMBERS, min_size=m, max_size=m)) for _ in range(k)] for k, m in ((n, 2), (1, n), (1, n)))
    return otr.map_network(otr.ReluNetwork([W, V], [b[0], [draw(NUMBERS)]], head=head or otr.Identity()))


@given(trees(), trees(), st.floats(0, 5))
def test_the_verdict_is_what_states_say(tree, other, most):
    verdict = otr.find_difference(tree, other, BOX, max_difference=most)
    X = np.random.default_rng(0).uniform(*BOX, (300, 2))
    apart = np.abs(tree.predict(X) - other.predict(X)).max()
    if verdict.holds:
        assert apart <= verdict.value + 1e-12 <= most + 1e-12
    else:  # exactly, at `point`; float64 rounds what is nearest to it
        assert verdict.value > most
        answers = (policy.predict(verdict.state)[0] for policy in (tree, other))
        assert abs(np.subtract(*answers)) == pytest.approx(verdict.value, abs=1e-9)


@settings(max_examples=15)
@given(trees(), st.integers(0, 2))
def test_a_tree_written_in_another_way_is_proved_equal(tree, head):
    heads = (otr.Identity(), otr.ClipBox([-1.0], [1.0]), otr.TanhBox([-1.0], [2.0]))
    tree = tree.replace(head=heads[head])
    again = otr.parse_program(otr.to_text(tree, feature_names=["a", "b"], precision=17), ["a", "b"])
    again = again.replace(head=heads[head])
    assert otr.find_difference(tree, again, BOX, max_difference=1e-9).holds
    moved = again.replace(c=again.c + 0.25)
    verdict = otr.find_difference(tree, moved, BOX, max_difference=0.125)
    assert (head == 1 and verdict.holds) or 0.125 < verdict.value <= 0.25 + 1e-9  # a clip may hide it


def test_labels_that_differ_in_a_corner_are_found():
    same, corner = (
        otr.parse_program(text, ["a", "b"], labels=True, output_names=["no", "yes"])
        for text in ("if a > 0: yes else: no", "if a > 0: yes\nelif a + b > 1.999 : yes else: no")
    )
    assert otr.find_difference(same, same, BOX).holds
    verdict = otr.find_difference(same, corner, BOX)
    assert not verdict.holds and same.predict(verdict.state) != corner.predict(verdict.state)
    assert otr.find_difference(same, corner, (np.array([-2.0, -2.0]), np.array([2.0, 1.5]))).holds


def test_what_cannot_be_compared_is_refused():
    tree = otr.parse_program("if a > 0: 1 else: b", ["a", "b"])
    with pytest.raises(ValueError, match="the heads are"):
        otr.find_difference(tree, tree.replace(head=otr.TanhBox([-1.0], [1.0])), BOX)
    with pytest.raises(ValueError, match="1 and 2 outputs"):
        otr.find_difference(tree, otr.parse_program("return a, b", ["a", "b"]), BOX)
    with pytest.raises(otr.TreeTooLargeError, match="4 pairs of leaves, more than 3"):
        otr.find_difference(tree, tree, BOX, max_leaves=3)
    labels = otr.map_network(otr.ReluNetwork([[[1.0, 0.0]]], [[0.0]], head=otr.Sign()))
    with pytest.raises(ValueError, match=r"max_difference is 2.0; labels are equal or not, leave it out"):
        otr.find_difference(labels, labels, BOX, max_difference=2.0)
    clipped = otr.map_network(otr.ReluNetwork([[[5.0]]], [[0.0]], head=otr.ClipBox(-1.0, 1.0)))
    assert otr.find_difference(clipped, clipped, (-1.0, 1.0), max_difference=3.0).value == 0.0
