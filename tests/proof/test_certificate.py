"""Certificates: they hold for equal functions, and nothing that was tampered with passes."""

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.core.domain import as_domain
from otr.core.network import UnitForm
from otr.geometry.rational import ExactTree, ExactUnits, as_point
from otr.proof.certificate import Cell, Certificate, Sum, check_cover
from otr.proof.exact_rows import TreeAndNetwork
from tests.core.strategies import Case, cases, make_network, worked_network
from tests.proof.test_changed_trees import BOXES
from tests.proof.test_changed_trees import network_of as network_of_kind

BOX = (-2.0, 2.0)


def network_of(
    seed: int = 0, widths: tuple[int, ...] = (5, 4), head: str = "identity", **more: object
) -> otr.ReluNetwork:
    return make_network(np.random.default_rng(seed), widths, n_inputs=2, n_outputs=3, head=head, **more)


Proved = tuple[otr.ReluNetwork, otr.ObliqueTree, Certificate]


@pytest.fixture(scope="module")
def proved() -> Proved:
    network = network_of(2)
    tree = otr.minimal_tree(network, BOX)
    return network, tree, otr.certify(tree, network, BOX)


def size_of_terms(network: otr.ReluNetwork) -> float:
    """Return the largest sum of the sizes of the terms that an output, or a neuron before it, is the sum of."""
    units = network.unit_form()
    sizes = UnitForm(np.abs(units.links), np.abs(units.inputs), np.abs(units.offsets), units.layer_starts)
    forms = sizes.forms(np.ones((1, network.n_hidden), dtype=np.bool_), network.negative_slope)
    return float(forms.sum(axis=2).max())


@settings(max_examples=60)
@given(cases(max_layers=3), st.booleans(), st.sampled_from(("layers", "balanced")))
def test_minimal_trees_are_certified(case: Case, in_box: bool, order: str) -> None:
    domain = BOX if in_box else None
    tree = otr.minimal_tree(case.network, domain, order=order)
    certificate = otr.certify(tree, case.network, domain)
    # Of labels it is a distance, and the longer the flatter an output is: up to the limit that `certify` itself has.
    assert case.network.head.gives_labels or certificate.max_error < 1e-8 * max(1.0, size_of_terms(case.network))
    assert certificate.n_empty == 0
    assert certificate.n_regions >= tree.n_leaves == certificate.n_leaves
    assert otr.verify(certificate, tree, case.network) == certificate.max_error


def test_the_bound_is_of_the_cells_that_are_kept_and_of_labels_that_are_ever_the_network_s() -> None:
    # The first cells of one leaf that are found here are given up for exact ones, and were proved to less.
    network = make_network(np.random.default_rng(0), (2, 3, 2), n_inputs=4, head="sign", negative_slope=0.01)
    tree = otr.minimal_tree(network)
    certificate = otr.certify(tree, network)
    assert otr.verify(certificate, tree, network) == certificate.max_error < 1e-6
    # Outputs 2 x - 4, -1 - x and 2 - x: at x = 2, the box's end, the first and the last tie, and the tree has the last.
    # The second is below the last by 3 everywhere: no input brings it to where the two would tie.
    weights = [[[0.0], [0.0]], [[-2.0, -2.0, 2.0], [2.0, -1.0, -1.0], [2.0, 0.0, -1.0]]]
    network = otr.ReluNetwork(weights, [[1.0, 2.0], [2.0, -1.0, 0.0]], dense="input", head=otr.Argmax())
    tree = otr.minimal_tree(network, BOX)
    assert tree.labels is not None and tree.labels.tolist() == [2]
    certificate = otr.certify(tree, network, BOX)
    assert otr.verify(certificate, tree, network) == certificate.max_error == 5e-324  # on the boundary alone


@settings(max_examples=30)
@given(cases(max_layers=2), st.booleans())
def test_full_trees_are_certified_empty_leaves_and_all(case: Case, in_box: bool) -> None:
    # Far out a rounded test may let a leaf have states, and then one with labels has others than the network.
    domain = BOX if in_box or case.network.head.gives_labels else None
    tree = otr.map_network(case.network)
    certificate = otr.certify(tree, case.network, domain)
    reached = {cell.leaf for cell in certificate.cells if cell.empty is None}
    assert certificate.n_empty + len(reached) == tree.n_leaves
    assert certificate.max_error < 1e-8


def test_the_bound_holds_where_it_is_checked_in_rational_arithmetic() -> None:
    network = network_of(3)
    tree = otr.minimal_tree(network, BOX)
    slightly_off = tree.replace(c=tree.c + 1e-9)
    certificate = otr.certify(slightly_off, network, BOX)
    assert 1e-9 <= certificate.max_error < 1.0001e-9
    exact, units = ExactTree(slightly_off), ExactUnits(network)
    for x in np.random.default_rng(0).uniform(-2, 2, (50, 2)):
        point = as_point(x)
        answers = zip(exact.outputs(exact.leaf(point), point), units.outputs(point), strict=True)
        assert max(abs(a - b) for a, b in answers) <= Fraction(certificate.max_error)


def test_a_worked_proof() -> None:
    # x > 1 and x > 0: the branch "x <= 0 but x > 1" is missing, as x = (x - 1) + 1.
    network = otr.ReluNetwork([[[1.0], [1.0]], [[1.0, 1.0]]], [[-1.0, 0.0], [0.0]])
    tree = otr.minimal_tree(network)
    certificate = otr.certify(tree, network)
    assert certificate.max_error == 0.0
    right = next(cell for cell in certificate.cells if cell.outcomes == "11")
    assert right == Cell(right.leaf, "11", (), (Sum(("test 0",), (1.0,)), Sum(("test 0",), (1.0,))))
    assert repr(certificate) == "Certificate(3 leaves, 0 of them empty, 3 regions, max_error=0 on R^d of 1 inputs)"


def test_on_an_open_domain_the_bound_is_by_the_size_of_the_inputs() -> None:
    network = network_of(1, (4,))
    tree = otr.minimal_tree(network)
    M = tree.M.copy()
    M[0, 0, 0] += 1e-8
    assert otr.certify(tree.replace(M=M), network).max_error == pytest.approx(1e-8, rel=1e-5)


@pytest.mark.parametrize("numbers", [(*range(6), 204), pytest.param(range(10_000), marks=pytest.mark.slow)])
def test_what_is_read_back_is_what_was_saved(numbers: Iterable[int], tmp_path: Path) -> None:
    for k in numbers:  # 204 named a row twice
        network, box = network_of_kind(np.random.default_rng(k), k), BOXES[k // 3 % 4]
        tree = otr.minimal_tree(network, box) if k % 4 < 2 or box is None else otr.map_network(network)
        certificate = otr.certify(tree, network, box)
        read = otr.load_certificate(certificate.save(tmp_path / "certificate.json"))
        assert read == certificate and otr.verify(read, tree, network) == certificate.max_error
    network = network_of()
    half_open = otr.certify(otr.minimal_tree(network), network, ([-1.0, -np.inf], [np.inf, 2.0]))
    assert otr.load_certificate(half_open.save(tmp_path / "open.json")) == half_open


def test_cells_are_as_deep_as_the_network_has_neurons() -> None:
    """More neurons than Python's calls go deep: x > k for k = 0 .. 1,099, each of which splits the only leaf."""
    n = 1100
    cells = [Cell(0, "1" * k + "0", tuple(range(k + 1))) for k in range(n)] + [Cell(0, "1" * n, tuple(range(n)))]
    check_cover(0, cells)
    with pytest.raises(otr.CertificateError, match="one side of test 0 is missing"):
        check_cover(0, cells[1:])


@pytest.mark.parametrize("head", ["clip_box", "argmax"])
def test_a_tampered_tree_is_refused_with_the_leaf(head: str) -> None:
    network = network_of(2, head=head)
    tree = otr.minimal_tree(network, BOX)
    certificate = otr.certify(tree, network, BOX)
    leaf, M = tree.n_leaves // 2, tree.M.copy()
    if head == "argmax":
        is_it = np.arange(tree.n_leaves) == leaf
        other = tree.replace(labels=np.where(is_it, (tree.labels + 1) % 3, tree.labels))
    else:
        M[leaf, 0, 0] += 1e-4
        other = tree.replace(M=M)
    with pytest.raises(otr.CertificateError, match=rf"^leaf {leaf}: at the state \[.* not the same") as refusal:
        otr.verify(certificate, other, network)
    assert TreeAndNetwork(other, network, certificate.domain).gap(refusal.value.state)[1] > certificate.max_error
    with pytest.raises(otr.CertificateError, match=rf"^leaf {leaf}:"):
        otr.certify(other, network, BOX)
    wrong = [tree.replace(children_left=tree.children_right, children_right=tree.children_left)]
    for node in range(0, tree.n_nodes, 3):
        moved = tree.replace(v=tree.v + 0.01 * (np.arange(tree.n_nodes) == node))
        # Else they have the same labels after all.
        if head != "argmax" or not otr.find_difference(moved, tree, BOX).holds:
            wrong.append(moved)
    for other in wrong:
        with pytest.raises(otr.CertificateError, match=r"^leaf \d+:"):
            otr.verify(certificate, other, network)


def test_another_network_and_a_pruned_tree_are_refused(proved: Proved) -> None:
    network, tree, certificate = proved
    weights = [W.copy() for W in network.weights]
    weights[0][0, 0] += 1e-3
    with pytest.raises(otr.CertificateError, match=r"^leaf \d+:"):
        otr.verify(certificate, tree, otr.ReluNetwork(weights, network.biases))
    with pytest.raises(otr.CertificateError, match="the head"):
        otr.verify(certificate, tree, network_of(2, head="argmax"))
    pruned = otr.prune_to_k(tree, np.random.default_rng(0).uniform(-2, 2, (300, 2)), 3)
    with pytest.raises(otr.CertificateError, match=r"leaf \d+: at the state \[.*the tree answers.*and the network"):
        otr.certify(pruned, network, BOX)


def tampered_certificates(certificate: Certificate) -> dict[str, tuple[int, Certificate]]:
    """Ways to lie, and the leaf that gives each away."""
    cells = certificate.cells
    at, proof = next(
        (i, j) for i, cell in enumerate(cells) for j, proof in enumerate(cell.proofs) if len(proof.rows) > 1
    )
    cell, terms = cells[at], cells[at].proofs[proof]

    def with_cell(other: Cell | None) -> Certificate:
        return replace(certificate, cells=tuple(c for c in (*cells[:at], other, *cells[at + 1 :]) if c is not None))

    def with_sum(rows: tuple[str, ...], multipliers: tuple[float, ...]) -> Certificate:
        proofs = (*cell.proofs[:proof], Sum(rows, multipliers), *cell.proofs[proof + 1 :])
        return with_cell(replace(cell, proofs=proofs))

    m = terms.multipliers
    other_test = next(f"test {i}" for i in range(1000) if f"test {i}" not in terms.rows)
    flipped = ("1" if cell.outcomes[0] == "0" else "0") + cell.outcomes[1:]
    return {
        "a negative multiplier": (cell.leaf, with_sum(terms.rows, (-m[0], *m[1:]))),
        "a wrong multiplier": (cell.leaf, with_sum(terms.rows, (m[0] * 1e6, *m[1:]))),
        "no multipliers": (cell.leaf, with_sum((), ())),
        "too few multipliers": (cell.leaf, with_sum(terms.rows, m[1:])),
        "not a number": (cell.leaf, with_sum(terms.rows, (float("nan"), *m[1:]))),
        "another row": (cell.leaf, with_sum((other_test, *terms.rows[1:]), m)),
        "a row that is none": (cell.leaf, with_sum(("test 12345", *terms.rows[1:]), m)),
        "another pattern": (cell.leaf, with_cell(replace(cell, outcomes=flipped))),
        "a short pattern": (cell.leaf, with_cell(replace(cell, outcomes=cell.outcomes[1:]))),
        "a cell less": (cell.leaf, with_cell(None)),
        "a split that is none": (cell.leaf, with_cell(replace(cell, splits=(0,), proofs=cell.proofs[1:]))),
        "another leaf": (cell.leaf, with_cell(replace(cell, leaf=(cell.leaf + 1) % certificate.n_leaves))),
        "a smaller error": (0, replace(certificate, max_error=certificate.max_error / 1e6)),
        "a leaf more": (certificate.n_leaves, replace(certificate, n_leaves=certificate.n_leaves + 1)),
    }


def test_a_tampered_certificate_is_refused_with_the_leaf(proved: Proved) -> None:
    network, tree, certificate = proved
    for lie, (leaf, tampered) in tampered_certificates(certificate).items():
        with pytest.raises(otr.CertificateError, match=r"^leaf \d+:") as refusal:
            otr.verify(tampered, tree, network)
        named = int(re.match(r"leaf (\d+)", str(refusal.value)).group(1))
        assert named == leaf or lie in ("a smaller error", "another leaf"), lie


def test_a_leaf_said_to_be_empty_is_checked() -> None:
    network = worked_network()
    tree = otr.map_network(network)
    certificate = otr.certify(tree, network, BOX)
    empty = next(cell for cell in certificate.cells if cell.empty is not None)
    reached = next(cell.leaf for cell in certificate.cells if cell.empty is None)
    for leaf, lie, words in ((reached, {"leaf": reached}, ""), (empty.leaf, {"empty": Sum((), ())}, " the cell ''")):
        others = tuple(cell for cell in certificate.cells if cell.leaf != leaf)
        with pytest.raises(otr.CertificateError, match=rf"^leaf {leaf}:{words}"):
            otr.verify(replace(certificate, cells=(*others, replace(empty, **lie))), tree, network)


def test_files_that_are_no_certificates(tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    network = worked_network()
    certificate = otr.certify(otr.minimal_tree(network), network)
    description = json.loads(certificate.save(path).read_text())
    first = description["cells"][0]
    fewer = {name: value for name, value in first.items() if name != "outcomes"}
    for cell, words in (({**first, "empty": "none"}, "cannot be read"), (fewer, "outcomes")):
        with pytest.raises(otr.ArtefactError, match=words):
            Certificate.from_dict(description | {"cells": [cell]})
    path.write_text("[]")
    with pytest.raises(otr.ArtefactError, match="expected 'otr/certificate/2'"):
        otr.load_certificate(path)
    path.unlink()
    with pytest.raises(otr.ArtefactError, match="cannot be read as JSON"):
        otr.load_certificate(path)


def test_what_cannot_be_certified_is_refused(proved: Proved) -> None:
    network, tree, _ = proved
    for error, words, ask in (
        (TypeError, "certify takes .* got ReluNetwork", lambda: otr.certify(network, tree, BOX)),
        (TypeError, "got dict, ObliqueTree, ReluNetwork", lambda: otr.verify({}, tree, network)),
        (TypeError, "network is a ObliqueTree", lambda: otr.minimal_tree(tree)),
        (otr.TreeTooLargeError, "limit of 5 regions", lambda: otr.certify(tree, network, BOX, max_regions=5)),
        (ValueError, "must be the same", lambda: otr.certify(tree, network_of(2, head="argmax"), BOX)),
        (ValueError, "max_error is", lambda: otr.certify(tree, network, BOX, max_error=np.nan)),
        (ValueError, "max_error is", lambda: otr.certify(tree, network, BOX, max_error=-1.0)),
        (ValueError, "wider than", lambda: otr.minimal_tree(network, (-1e308, 1e308))),
        (ValueError, "expected None, a pair", lambda: otr.minimal_tree(network, "box")),
    ):
        with pytest.raises(error, match=words):
            ask()


def test_forgeries_by_overflow_are_refused(proved: Proved) -> None:
    network, tree, true = proved
    for huge in (1.0, 1e308, Fraction(10) ** 400):
        all_empty = tuple(
            Cell(leaf, "", (), empty=Sum(("low 0", "high 0"), (huge, huge))) for leaf in range(tree.n_leaves)
        )
        with pytest.raises(otr.CertificateError, match=r"^leaf 0: the cell '' is said to be empty"):
            otr.verify(replace(true, cells=all_empty), tree, network)
        cell = next(cell for cell in true.cells if any(proof.rows for proof in cell.proofs))
        overflowing = tuple(Sum(proof.rows, tuple(10**9 * huge for _ in proof.rows)) for proof in cell.proofs)
        others = tuple(other for other in true.cells if other is not cell)
        with pytest.raises(otr.CertificateError, match=rf"^leaf {cell.leaf}:"):
            otr.verify(replace(true, cells=(*others, replace(cell, proofs=overflowing))), tree, network)
    for max_error in (np.inf, np.nan, -1.0):
        with pytest.raises(otr.CertificateError, match="a finite error"):
            otr.verify(replace(true, max_error=max_error), tree, network)


THIN = (
    ("if x == 0: 5 else: max(x, 0)", (-1.0, 1.0)),
    ("if x == 0: 5 else: max(x, 0)", None),
    ("if x == 0.1: 5 else: max(x, 0)", (-1.0, 1.0)),
    ("if x > 0.5 and x <= 0.502: 1000 else: max(x, 0)", (-1e6, 1e6)),
    ("if x > 0.5 and x <= 0.5000000000000001: 7 else: max(x, 0)", (-1.0, 1.0)),
    ("if x >= 1: 7 else: max(x, 0)", (-1.0, 1.0)),  # at the box's edge alone
)


@pytest.mark.parametrize(("text", "box"), THIN)
def test_a_leaf_of_a_single_point_counts(text: str, box: tuple[float, float] | None) -> None:
    network = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]])
    tree = otr.parse_program(text, ["x"])
    with pytest.raises(otr.CertificateError, match=r"leaf \d+: at the state \[.*\] the tree answers \[") as refusal:
        otr.certify(tree, network, box)
    leaf, gap = TreeAndNetwork(tree, network, as_domain(box, 1)).gap(refusal.value.state)
    assert leaf == refusal.value.leaf and gap > 1


def test_a_leaf_beyond_all_floats_counts() -> None:
    """Its test turns at x = 2e323, where no float64 is."""
    network = otr.ReluNetwork([[[1.0]]], [[0.0]])
    tree = otr.ObliqueTree([~0], [~1], [[5e-324]], [-1.0], [[[1.0]], [[3.0]]], [[0.0], [0.0]])
    with pytest.raises(otr.CertificateError, match=r"leaf 1: at the state \[about 2\*\*\d+\]") as refusal:
        otr.certify(tree, network)
    assert TreeAndNetwork(tree, network, as_domain(None, 1)).leaf(refusal.value.state) == 1
    assert otr.certify(tree, network, (-1e100, 1e100)).n_empty == 1


def test_where_no_leaf_has_an_inner_point_cells_are_exact_and_one_that_only_touches_is_empty() -> None:
    network = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]])
    for box in ((1e12, 1e12 + 1e-3), (1e9, 1e9 + 2e-6), (1e15, np.inf)):
        assert otr.certify(otr.minimal_tree(network, box), network, box).max_error == 0.0
    linear = otr.ReluNetwork([[[1.0]]], [[0.0]])  # x > 1 is no state of [-1, 1], and x <= 0 and x > 0 none at all
    assert otr.certify(otr.parse_program("if x > 1: 9 else: x", ["x"]), linear, (-1.0, 1.0)).n_empty == 1
    maps = [[[1.0]], [[0.0]], [[1.0]]], [[0.0], [9.0], [0.0]]
    assert otr.certify(otr.ObliqueTree([~0, ~1], [1, ~2], [[1.0]] * 2, [0.0, 0.0], *maps), linear).max_error == 0.0


def test_thin_leaves_that_are_right_are_covered() -> None:
    """The network is cut along y inside the leaf x == 0, which has no inside."""
    network = otr.ReluNetwork([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])
    right = otr.parse_program("if x == 0: max(y, 0) else: max(x, 0) + max(y, 0)", ["x", "y"])
    certificate = otr.certify(right, network, BOX)
    assert (certificate.max_error, otr.verify(certificate, right, network)) == (0.0, 0.0)
    wrong = otr.parse_program("if x == 0: y else: max(x, 0) + max(y, 0)", ["x", "y"])
    with pytest.raises(otr.CertificateError, match=r"at the state \[0.0, -"):
        otr.certify(wrong, network, BOX)


def test_a_sliver_is_bounded_by_its_own_difference() -> None:
    """The tree's boundary is off by 1e-8: on the sliver between, tree and network differ by that much, not by 1."""
    network = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]])
    tree = otr.ObliqueTree([~0], [~1], [[1.0]], [-1e-8], [[[0.0]], [[1.0]]], [[0.0], [0.0]])
    for domain in ((-1.0, 1.0), None):
        certificate = otr.certify(tree, network, domain)
        assert 1e-8 <= otr.verify(certificate, tree, network) == certificate.max_error <= 1.01e-8
    with pytest.raises(otr.CertificateError, match="not the same function"):
        otr.certify(tree, network, (-1.0, 1.0), max_error=9e-9)


def test_the_tests_of_an_argmax_are_not_split_again_by_rounding() -> None:
    """A leaf's tests of the label are the network's up to rounding; cells between the two would double the proof."""
    network = make_network(np.random.default_rng(0), (6,), n_inputs=8, n_outputs=4, head="argmax")
    tree = otr.minimal_tree(network)
    certificate = otr.certify(tree, network)
    assert tree.n_leaves <= certificate.n_regions <= 1.2 * tree.n_leaves
    assert otr.verify(certificate, tree, network) == certificate.max_error


def test_labels_of_outputs_that_tie_are_those_of_the_network() -> None:
    off = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]], head=otr.Sign())  # max(0, x) > 0
    one = otr.ObliqueTree([], [], np.zeros((0, 1)), [], np.zeros((1, 1, 1)), [[1.0]], labels=[1], head=otr.Sign())
    with pytest.raises(otr.CertificateError, match=r"at the state \[-.*\] the tree answers 1 and the network 0"):
        otr.certify(one, off, BOX)
    assert otr.certify(otr.minimal_tree(off, BOX), off, BOX).max_error == 0.0
    # Right but at the point 0, on the boundary between its labels
    but_zero = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]], head=otr.Sign())
    certificate = otr.certify(one, but_zero, BOX)
    assert certificate.max_error == otr.verify(certificate, one, but_zero) == 5e-324
    with pytest.raises(otr.CertificateError, match=r"the state \[0.0\] .*|no proof to 0 was found"):
        otr.certify(one, but_zero, BOX, max_error=0.0)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_labels_do_not_depend_on_the_size_of_outputs(size: float) -> None:
    network = otr.ReluNetwork([[[size, 0.0]]], [[0.0]], head=otr.Sign())
    near = otr.ObliqueTree([-1], [-2], [[1.0, 0.0]], [0.0], np.zeros((2, 1, 2)), [[-1.0], [1.0]], labels=[0, 1],
                           head=otr.Sign())  # fmt: skip
    assert otr.certify(near, network, BOX).max_error == 0.0
    moved = near.replace(v=np.array([1e-8]))
    assert otr.certify(moved, network, BOX, max_error=2e-8).max_error == pytest.approx(1e-8)
    with pytest.raises(otr.CertificateError, match="not the same function"):
        otr.certify(near.replace(v=np.array([1e-4])), network, BOX)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from((("sign", 1), ("argmax", 2), ("argmax", 4))), st.data())
def test_no_leaf_with_another_label_is_proved(seed: int, head: tuple[str, int], data: st.DataObject) -> None:
    rng, (name, n_outputs) = np.random.default_rng(seed), head
    network = make_network(rng, (4,), n_inputs=2, n_outputs=n_outputs, head=name)
    # Without biases all outputs are 0 where no neuron is active.
    network = otr.ReluNetwork(network.weights, [network.biases[0], np.zeros(n_outputs)], head=network.head)
    tree = otr.minimal_tree(network, BOX)
    certificate = otr.certify(tree, network, BOX)
    assert tree.labels is not None
    leaf, labels = data.draw(st.integers(0, tree.n_leaves - 1)), tree.labels.copy()
    labels[leaf] = (labels[leaf] + 1) % max(n_outputs, 2)
    other = tree.replace(labels=labels)
    X = rng.uniform(-2, 2, (20_000, 2))
    if (other.predict(X) != network.predict(X)).any():
        with pytest.raises(otr.CertificateError, match=rf"^leaf {leaf}:"):
            otr.verify(certificate, other, network)
