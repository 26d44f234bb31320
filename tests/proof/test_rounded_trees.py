"""Trees with rounded coefficients: a cell for each leaf, and a bound that is near to what is seen."""

from fractions import Fraction

import numpy as np
import pytest

import otr
from benchmarks.rounding import rounded_tree
from otr.geometry.rational_linear_programs import ExactBox, largest_value, near_largest
from otr.proof.certificate import Cell, Certificate, Sum
from otr.proof.exact_rows import TreeAndNetwork
from tests.core.strategies import make_network
from tests.proof.labels import wrong_states_far_from_a_tie
from tests.proof.test_changed_trees import gaps

BOX = (-2.0, 2.0)


def rounded_pair(
    seed: int, widths: tuple[int, ...], bits: int, head: str = "clip_box", **more: object
) -> tuple[otr.ObliqueTree, otr.ReluNetwork]:
    network = make_network(np.random.default_rng(seed), widths, n_outputs=3, head=head, **more)
    limits = np.full(network.n_inputs, BOX[0]), np.full(network.n_inputs, BOX[1])
    return rounded_tree(otr.minimal_tree(network, BOX), *limits, bits), network


@pytest.mark.parametrize(("widths", "n_inputs", "dense"), [((6,), 8, "input"), ((6,), 14, False), ((3, 3), 3, False)])
def test_each_leaf_is_one_cell_and_the_bound_is_near_to_what_is_seen(
    widths: tuple[int, ...], n_inputs: int, dense: object
) -> None:
    tree, network = rounded_pair(3, widths, 12, n_inputs=n_inputs, dense=dense)
    X = np.random.default_rng(0).uniform(*BOX, (50_000, n_inputs))
    seen = np.abs(tree.forward(X) - network.forward(X)).max()
    certificate = otr.certify(tree, network, BOX, max_error=100 * seen)
    assert len(certificate.cells) == tree.n_leaves
    assert seen <= certificate.max_error <= 5 * seen  # sampled in 14 inputs it is far from the corners
    assert otr.verify(certificate, tree, network) == certificate.max_error


@pytest.mark.parametrize("seed", range(3))
def test_the_bound_holds_at_every_cell_s_corners_and_a_smaller_one_is_proved_or_refused(seed: int) -> None:
    tree, network = rounded_pair(seed, (4,) if seed % 2 else (3, 2), 8, n_inputs=2, negative_slope=0.1)
    first = otr.certify(tree, network, BOX, max_error=10.0)
    largest = max(gaps(tree, network, BOX))
    assert largest <= Fraction(first.max_error)
    for share in (0.98, 0.9):  # of what is surely true; and of what is not
        bound = float(largest) / share
        assert largest <= Fraction(otr.certify(tree, network, BOX, max_error=bound).max_error) <= Fraction(bound)
        with pytest.raises(otr.CertificateError, match="not the same function") as refusal:
            otr.certify(tree, network, BOX, max_error=float(largest) * share)
        assert TreeAndNetwork(tree, network, first.domain).gap(refusal.value.state)[1] > largest * Fraction(share)


@pytest.mark.parametrize("head", ["argmax", "sign"])
def test_labels_of_a_rounded_tree_are_proved_in_few_cells(head: str) -> None:
    network = make_network(np.random.default_rng(1), (3,), n_inputs=4, n_outputs=1 if head == "sign" else 3, head=head)
    tree = rounded_tree(otr.minimal_tree(network, BOX), np.full(4, BOX[0]), np.full(4, BOX[1]), 14)
    certificate = otr.certify(tree, network, BOX, max_error=0.05)
    assert len(certificate.cells) <= 1.5 * tree.n_leaves
    assert 0 < otr.verify(certificate, tree, network) <= 0.05
    assert not wrong_states_far_from_a_tie(tree, network, BOX, Fraction(certificate.max_error))


@pytest.mark.parametrize("part", ["P", "v", "M", "c"])
def test_a_coefficient_that_is_wrong_is_refused_with_the_state(part: str) -> None:
    tree, network = rounded_pair(3, (6,), 12, n_inputs=8)
    certificate = otr.certify(tree, network, BOX, max_error=1.0)
    numbers = getattr(tree, part).copy()
    numbers.ravel()[np.abs(numbers).argmax()] *= 1.1
    other = tree.replace(**{part: numbers})
    for refused in (
        lambda: otr.certify(other, network, BOX, max_error=certificate.max_error),
        lambda: otr.verify(certificate, other, network),
    ):
        with pytest.raises(otr.CertificateError, match="not the same function") as refusal:
            refused()
        gap = TreeAndNetwork(other, network, certificate.domain).gap(refusal.value.state)[1]
        assert gap > Fraction(certificate.max_error)


@pytest.mark.parametrize(("weights", "bound"), [((1.0, -1.0), 0.1), ((1.0, 1.0), 0.2), ((-1.0, -3.0), 0.4)])
def test_errors_of_activations_count_in_the_direction_that_they_have(
    weights: tuple[float, float], bound: float
) -> None:
    """Twice relu(x) on [-0.1, 1], said to be x there: each is above that by 0.1 at most, and nowhere below."""
    network = otr.ReluNetwork([[[1.0], [1.0]], [list(weights)]], [[0.0, 0.0], [0.0]])
    tree = otr.parse_program(f"return {sum(weights)!r} * x", ["x"])
    cell = Cell(0, "11", (), (Sum((), ()), Sum((), ())))
    certificate = Certificate(otr.Domain([-0.1], [1.0]), 1.0, 1, 0, (cell,))
    assert otr.verify(certificate, tree, network) == pytest.approx(bound, rel=1e-12)


def test_sums_found_in_floating_point_bound_forms_as_those_of_rational_programs() -> None:
    rng = np.random.default_rng(0)
    rows, forms = (rng.integers(-1000, 1000, (n, 6)).astype(object) for n in (4, 5))
    rows[:, -1] = abs(rows[:, -1])
    box = ExactBox(np.full(5, -1.0), np.full(5, 2.0))
    found = near_largest(rows, forms, box)
    assert found is not None
    for state, multipliers, form in zip(*found, forms, strict=True):
        total = sum((rows[row] * Fraction(value) for row, value in multipliers.items()), form)
        highest = total[-1] + sum(max(-slope, 2 * slope) for slope in total[:-1])
        exact = largest_value(rows, form.tolist(), Fraction(10**9), box).t
        assert exact <= highest <= exact + Fraction(1, 10**6)
        assert float(exact) == pytest.approx(form[:-1] @ state + form[-1], rel=1e-9)
    nowhere = np.concatenate((rows, -rows - np.eye(6, dtype=np.int64)[-1].astype(object)))
    assert near_largest(nowhere, forms, box) is None


def test_gains_are_what_an_output_changes_by_with_an_activation() -> None:
    network = make_network(np.random.default_rng(0), (3, 2), n_inputs=2, n_outputs=2, dense="all")
    W2, W3 = network.weights[1], network.weights[2]
    of_last = np.abs(W3[:, 3:5])
    of_first = np.abs(W3[:, :3]) + of_last @ np.abs(W2[:, :3])
    assert np.allclose(network.gains(), np.concatenate((of_first.max(axis=0), of_last.max(axis=0))), rtol=1e-15)


def test_a_neuron_that_no_output_reads_splits_no_leaf() -> None:
    network = otr.ReluNetwork([[[1.0], [1.0]], [[1.0, 0.0]]], [[0.0, 0.5], [0.0]])
    tree = otr.parse_program("if x <= 0: 0 else: x", ["x"])
    for max_error in (1e-6, 10.0):
        certificate = otr.certify(tree, network, BOX, max_error=max_error)
        assert [cell.splits for cell in certificate.cells] == [(), ()] and certificate.max_error == 0
    with pytest.raises(otr.CertificateError, match="not the same function"):
        otr.certify(tree.replace(v=np.array([20.0])), network, (-30.0, 30.0), max_error=10.0)
