"""Certificates on boxes of many inputs, whose sides are no rows of the proof."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.core.domain import Domain
from otr.proof.exact_rows import TreeAndNetwork
from tests.core.strategies import Case, cases, make_network
from tests.proof.test_labels import check_corrupted

BOX = (-1.0, 1.0)


def names_of(certificate: otr.Certificate) -> set[str]:
    sums = [each for cell in certificate.cells for each in (*cell.proofs, *cell.bounds, cell.empty) if each is not None]
    return {name.split()[0] for each in sums for name in each.rows}


@pytest.mark.parametrize("head", ["identity", "argmax", "tanh_box"])
@pytest.mark.parametrize("dense", [False, "input"])
def test_a_proof_is_of_tests_alone_and_holds(head: str, dense: object, tmp_path) -> None:
    network = make_network(np.random.default_rng(0), (4, 2), n_inputs=70, n_outputs=2, head=head, dense=dense)
    tree = otr.minimal_tree(network, BOX)
    certificate = otr.certify(tree, network, BOX)
    assert names_of(certificate) <= {"test", "neuron"} and certificate.n_empty == 0
    again = otr.load_certificate(certificate.save(tmp_path / "certificate.json"))
    assert otr.verify(again, tree, network) == certificate.max_error < 1e-11

    # Without its basis the tree is rounded, and proved in the inputs themselves.
    plain = tree.replace(P=tree.P, M=tree.M)
    assert plain.basis is None
    assert otr.verify(replace(again, max_error=1e-11), plain, network) <= 1e-11
    assert otr.verify(otr.certify(plain, network, BOX), plain, network) < 1e-11


def test_thirty_inputs_are_proved_in_seconds() -> None:
    network = make_network(np.random.default_rng(0), (7,), n_inputs=30, n_outputs=2)
    tree = otr.minimal_tree(network, BOX)
    certificate = otr.certify(tree, network, BOX, max_seconds=20)
    assert certificate.n_regions == 2**7 and otr.verify(certificate, tree, network) < 1e-13


def test_what_is_wrong_is_refused_with_a_state() -> None:
    network = make_network(np.random.default_rng(1), (5,), n_inputs=90, n_outputs=2)
    tree = otr.minimal_tree(network, BOX)
    certificate = otr.certify(tree, network, BOX)
    M = tree.M_of_basis.copy()
    M[3, 0, 0] += 1e-3
    wrong = tree.replace(P=tree.P_of_basis, M=M, basis=tree.basis)
    with pytest.raises(otr.CertificateError, match=r"^leaf 3: at the state \[.* not the same function") as refusal:
        otr.verify(certificate, wrong, network)
    pair = TreeAndNetwork(wrong, network, certificate.domain)
    assert pair.is_inside(refusal.value.state) and pair.gap(refusal.value.state)[1] > certificate.max_error
    with pytest.raises(otr.CertificateError, match=r"^leaf 3: at the state \["):
        otr.certify(wrong, network, BOX)
    cell = next(cell for cell in certificate.cells if any(proof.rows for proof in cell.proofs))
    bare = replace(cell, proofs=tuple(replace(proof, rows=(), multipliers=()) for proof in cell.proofs))
    others = tuple(each for each in certificate.cells if each is not cell)
    with pytest.raises(otr.CertificateError, match=rf"^leaf {cell.leaf}:"):
        otr.verify(replace(certificate, cells=(*others, bare)), tree, network)


def test_a_proof_that_names_sides_is_checked_as_before() -> None:
    network = make_network(np.random.default_rng(2), (4,), n_inputs=64, n_outputs=2)
    tree = otr.map_network(network.replace(biases=[network.biases[0] + [0, 0, 0, 60], network.biases[1]]))
    shifted = network.replace(biases=[network.biases[0] + [0, 0, 0, 60], network.biases[1]])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Domain, "n_bounded", 0)
        certificate = otr.certify(tree, shifted, BOX)
    assert {"low", "high"} <= names_of(certificate) and certificate.n_empty > 0
    assert otr.verify(certificate, tree, shifted) == certificate.max_error
    in_box = otr.certify(tree, shifted, BOX)
    assert in_box.n_empty == certificate.n_empty and names_of(in_box) <= {"test", "neuron"}


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_wrong_states_of_labels_that_are_accepted_are_near_a_tie(seed: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Domain, "n_bounded", 10**9)
        check_corrupted(seed, "argmax", BOX)


@pytest.mark.parametrize("shift", [0.0, 1e-11])
def test_labels_of_many_inputs_are_proved_and_a_wrong_one_is_refused(shift: float, tmp_path) -> None:
    network = make_network(np.random.default_rng(3), (4, 3), n_inputs=100, n_outputs=3, head="argmax")
    tree = otr.minimal_tree(network, BOX)
    tree = tree.replace(P=tree.P_of_basis, M=tree.M_of_basis, basis=tree.basis, v=tree.v + shift)
    certificate = otr.certify(tree, network, BOX)
    assert names_of(certificate) <= {"test", "neuron"} and not any(cell.bounds for cell in certificate.cells)
    again = otr.load_certificate(certificate.save(tmp_path / "certificate.json"))
    assert otr.verify(again, tree, network) == certificate.max_error < 1e-11 + 1e3 * shift
    labels = tree.labels.copy()
    labels[0] = (labels[0] + 1) % 3
    wrong = tree.replace(P=tree.P_of_basis, M=tree.M_of_basis, basis=tree.basis, labels=labels)
    with pytest.raises(otr.CertificateError, match=r"^leaf 0: at the state \[.* the tree answers . and"):
        otr.certify(wrong, network, BOX)
    with pytest.raises(otr.CertificateError, match=r"^leaf 0:"):
        otr.verify(again, wrong, network)


def test_a_way_out_of_the_box_is_refused() -> None:
    """Label 1 is at x_0 > 0.5, or nowhere in the box; the tree has it from 0.5 - 1e-8 on."""
    weights = np.eye(64)[:1]
    tree = otr.ObliqueTree([~0], [~1], weights, [1e-8 - 0.5], np.zeros((2, 1, 64)), np.zeros((2, 1)), labels=[0, 1],
                           head=otr.Sign())  # fmt: skip
    with pytest.raises(otr.CertificateError, match=r"^leaf 1: at the state"):
        otr.certify(tree, otr.ReluNetwork([weights], [[-1.0]], head=otr.Sign()), BOX)
    # Where states come to the label only along the box's side, the sides are rows.
    by_side = otr.ReluNetwork([weights], [[2e-8 - 1]], head=otr.Sign())
    moved = tree.replace(v=np.array([3e-8 - 1]))
    along = otr.certify(moved, by_side, BOX)
    assert otr.verify(along, moved, by_side) == along.max_error == pytest.approx(1e-8, rel=1e-3)
    network = otr.ReluNetwork([weights], [[-0.5]], head=otr.Sign())
    certificate = otr.certify(tree, network, BOX)
    at, cell = next((i, cell) for i, cell in enumerate(certificate.cells) if cell.leaf == 1)
    inside = np.array([float(number) for number in cell.towards])
    assert 0 < certificate.max_error < 1e-7 and abs(inside[:-1]).max() <= inside[-1] == 1
    for lie in (inside * [*[2.0] * 64, 1.0], np.append(inside[:-1], 0.0), -inside, np.eye(65)[0]):
        cells = (*certificate.cells[:at], replace(cell, towards=tuple(lie.tolist())), *certificate.cells[at + 1 :])
        with pytest.raises(otr.CertificateError, match=rf"^leaf {cell.leaf}:"):
            otr.verify(replace(certificate, cells=cells), tree, network)


@settings(max_examples=40)
@given(cases(max_layers=2), st.sampled_from(("box", "half open", "open", "constant")), st.booleans())
def test_all_kinds_are_proved_where_every_box_counts_as_wide(case: Case, kind: str, is_full: bool) -> None:
    network, d = case.network, case.network.n_inputs
    low, high = np.full(d, -2.0), np.full(d, 2.0)
    if kind == "half open":
        high[0] = np.inf
    elif kind == "open":
        low[-1], high[-1] = -np.inf, np.inf
    elif kind == "constant":
        low[0] = 2.0
    if is_full and network.head.gives_labels and kind in ("open", "half open"):
        return  # far out a rounded test may let a leaf have states, and then one with labels has others
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Domain, "n_bounded", 10**9)
        tree = otr.map_network(network) if is_full else otr.minimal_tree(network, (low, high))
        certificate = otr.certify(tree, network, (low, high))
        assert otr.verify(certificate, tree, network) == certificate.max_error < 1e-6
    assert otr.verify(certificate, tree, network) < 1e-6  # the sides may still be rows
