"""What the integers answer: what Python's integers do, without overflow, and what the tree of real numbers does."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from tests.core.strategies import cases

BOX = 2.0


def reference(fixed: otr.FixedPointTree, q: list[int]) -> list[int] | int:
    """Answer integers as the class's docstring says, in Python's integers; every number is to fit the accumulator."""
    limit = 2 ** (fixed.accumulator_bits - 1)

    def fits(value: int) -> int:
        assert -limit <= value < limit, value
        return value

    def affine(row: list[int], total: int) -> int:
        for coefficient, value in zip(row, q, strict=True):
            total = fits(total + fits(coefficient * value))
        return total

    q = [
        min(max(x, low), high)
        for x, low, high in zip(q, fixed.input_low.tolist(), fixed.input_high.tolist(), strict=True)
    ]
    node = 0 if fixed.n_nodes else -1
    while node >= 0:
        goes_left = affine(fixed.P[node].tolist(), int(fixed.v[node])) <= 0
        node = int((fixed.children_left if goes_left else fixed.children_right)[node])
    if fixed.labels is not None:
        return int(fixed.labels[~node])
    r = []
    for k, shift in enumerate(fixed.shifts[~node].tolist()):
        start = fits(int(fixed.c[~node, k]) + ((1 << shift) >> 1))
        r.append(affine(fixed.M[~node, k].tolist(), start) >> shift)
    if fixed.head.gives_labels:
        return r.index(max(r)) if isinstance(fixed.head, otr.Argmax) else int(r[0] > 0)
    if fixed.output_limits is not None:
        return [min(max(y, int(low)), int(high)) for y, low, high in zip(r, *fixed.output_limits, strict=True)]
    if fixed.table is None:
        return r
    answers = []
    for k, y in enumerate(r):
        T = fixed.table.values[k % len(fixed.table.values)].tolist()
        a, bits = min(abs(y), fixed.table.last), fixed.table.step_bits
        step = min(a >> bits, len(T) - 2)
        rest = a - (step << bits)
        value = T[step] + (fits((T[step + 1] - T[step]) * rest + ((1 << bits) >> 1)) >> bits)
        answers.append(value if y >= 0 else -value)
    return answers


@given(cases(max_layers=2), st.sampled_from((4, 8, 16, 24)), st.sampled_from((32, 64)), st.booleans(), st.data())
def test_integers_are_those_of_python_and_no_sum_overflows(case, bits, accumulator_bits, of_tests, data):
    network = case.network
    tree = otr.map_network(network)
    if network.head.gives_labels and not of_tests:
        tree = tree.replace(labels=None)
    try:
        fixed = otr.to_fixed_point(tree, (-BOX, BOX), bits, accumulator_bits=accumulator_bits)
    except otr.InvalidTreeError as error:
        assert "bits" in str(error)
        return
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    reach = int(fixed.input_high.max()) + 3  # beyond what is clamped
    Q = rng.integers(-reach, reach + 1, (20, network.n_inputs))
    answers = fixed.predict_integers(Q)
    assert answers.tolist() == [reference(fixed, q) for q in Q.tolist()]
    assert fixed.predict_integers(Q[0]).tolist() == answers[0].tolist()


@given(cases(heads=("identity", "clip_box", "tanh_box"), max_layers=2), st.sampled_from((6, 12, 16)))
def test_the_tree_of_real_numbers_is_that_of_the_integers(case, bits):
    tree = otr.map_network(case.network)
    fixed = otr.to_fixed_point(tree, (-BOX, BOX), bits)
    exact, (inputs, units) = fixed.to_tree(), fixed.dyadic_scales()
    assert exact.head == tree.head
    for k, leaf in np.ndindex(fixed.n_outputs, fixed.n_leaves):
        step = units[k] / 2 ** int(fixed.shifts[leaf, k])
        assert Fraction(exact.c[leaf, k]) == int(fixed.c[leaf, k]) * step
        assert [Fraction(m) for m in exact.M[leaf, k]] == [
            int(m) * t * step for m, t in zip(fixed.M[leaf, k], inputs, strict=True)
        ]


def test_a_row_that_overflows_is_refused_with_both_numbers():
    tree = otr.parse_program("if x <= 0.5: -x else: 2 x", ["x"])
    fixed = otr.to_fixed_point(tree, ([-1], [1]), bits=8)
    with pytest.raises(
        otr.InvalidTreeError, match=r"leaf, output 0, 0: .* may reach 21474\d+, expected at most 2147483647"
    ):
        fixed.replace(c=fixed.c + 2**31 - 1)
    with pytest.raises(otr.InvalidTreeError, match="P holds 128, of 8 bits, expected below 128"):
        fixed.replace(P=[[128]])
    with pytest.raises(otr.InvalidTreeError, match=r"leaf 1, output 0: in units of 1/1048576 .* coarser output scale"):
        otr.to_fixed_point(tree, ([-1], [1]), bits=8, output_scales=[Fraction(1, 2**20)])
    with pytest.raises(TypeError, match="no entry for the head Exp"):
        otr.to_fixed_point(tree.replace(head=otr.Exp()), ([-1], [1]))
    with pytest.raises(ValueError, match="NaN"):
        fixed.predict([np.nan])


def test_scales_of_a_sensor_and_an_actuator_are_kept():
    tree = otr.parse_program("if x + y <= 0.5: 0.7 - x / 3 else: 2 x", ["x", "y"]).replace(head=otr.ClipBox(-1, 1))
    fixed = otr.to_fixed_point(tree, (0, 5), input_scales=["5/1023", 0.01], output_scales=[Fraction(1, 127)])
    assert fixed.input_high.tolist() == [1023, 500] and fixed.input_scales[0] == Fraction(5, 1023)
    assert [limit.tolist() for limit in fixed.output_limits] == [[-127], [127]]
    X = np.random.default_rng(0).uniform(0, 5, (1000, 2))
    away = np.abs(tree.test_forms @ np.vstack((X.T, np.ones(1000))))[0] > 0.02
    assert np.abs(fixed.predict(X) - tree.predict(X))[away].max() < 0.5 / 127 + 2 * 5 / 1023


@pytest.mark.parametrize("head", ["clip_box", "tanh_box", "argmax"])
def test_saved_and_loaded_it_is_the_same(tmp_path, head):
    from tests.core.strategies import make_network

    network = make_network(np.random.default_rng(1), (3,), n_outputs=2, head=head)
    tree = otr.map_network(network).replace(feature_names=["a", "b", "c"])
    fixed = otr.to_fixed_point(tree, (-1, 1), 12)
    loaded = otr.load(otr.save(fixed, tmp_path / "policy"))
    assert isinstance(loaded, otr.FixedPointTree) and loaded.feature_names == ("a", "b", "c")
    Q = np.random.default_rng(2).integers(-3000, 3000, (500, 3))
    np.testing.assert_array_equal(loaded.predict_integers(Q), fixed.predict_integers(Q))
    assert "if " in otr.to_text(loaded.to_tree()) and "<svg" in otr.to_svg(loaded.to_tree())
