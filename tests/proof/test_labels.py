"""Certificates of labels: a wrong label is no farther than the bound from where the network's outputs tie."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from tests.core.strategies import make_network
from tests.proof.labels import wrong_states_far_from_a_tie

BOX = (-1.0, 1.0)


def leaf_between(low: float, high: float, labels: tuple[int, int], head: otr.Head, d: int = 1) -> otr.ObliqueTree:
    P, o = np.eye(d)[[0, 0]], 1 if head == otr.Sign() else 2
    return otr.ObliqueTree(
        [~0, ~1], [1, ~2], P, [-low, -high], np.zeros((3, o, d)), np.zeros((3, o)),
        labels=[labels[1], labels[0], labels[1]], head=head,
    )  # fmt: skip


def bump(size: float, offset: float, d: int = 1, at: float = 0.0) -> otr.ReluNetwork:
    return otr.ReluNetwork([size * np.eye(d)[:1], [[1.0]]], [[-size * at], [offset]], head=otr.Sign())


NEVER_TIED = {
    "sign": (bump(1000.0, 1e-4), leaf_between(0.0, 1e-7, (0, 1), otr.Sign()), BOX),
    "sign, on R": (bump(1000.0, 1e-4), leaf_between(0.0, 1e-7, (0, 1), otr.Sign()), None),
    "two inputs": (bump(1000.0, 1e-4, d=2), leaf_between(0.0, 1e-7, (0, 1), otr.Sign(), d=2), BOX),
    "far out": (bump(1.0, 1e-3, at=1e9), leaf_between(1e9 - 200, 1e9 + 200, (0, 1), otr.Sign()), None),
    "argmax": (
        otr.ReluNetwork([[[1000.0]], [[1.0], [0.0]]], [[0.0], [1e-4, 0.0]], head=otr.Argmax()),
        leaf_between(0.0, 1e-7, (1, 0), otr.Argmax()),
        BOX,
    ),
    "the tie is outside of the box": (
        otr.ReluNetwork([[[1.0]]], [[1.0 + 1e-8]], head=otr.Sign()),
        leaf_between(-1.0, -1.0 + 1e-9, (0, 1), otr.Sign()),
        BOX,
    ),
    "however thin": (bump(1e9, 1e-9), leaf_between(0.0, 5e-324, (0, 1), otr.Sign()), BOX),
}


@pytest.mark.parametrize("case", NEVER_TIED)
def test_labels_that_never_tie_admit_no_wrong_leaf(case: str) -> None:
    network, tree, box = NEVER_TIED[case]
    with pytest.raises(otr.CertificateError, match=r"^leaf 1: at the state \[.* the tree answers . and the network"):
        otr.certify(tree, network, box)


def tied(seed: int, without_biases: bool) -> otr.ReluNetwork:
    """A network whose outputs are all 0 where no neuron is active, or whose first two are the same."""
    network = make_network(np.random.default_rng(seed), (3, 3), n_inputs=2, n_outputs=3, head="argmax")
    if without_biases:
        return network.replace(biases=[np.zeros(3)] * 3)
    same = [0, 0, 2]
    last, offsets = network.weights[-1][same], network.biases[-1][same]
    return network.replace(weights=[*network.weights[:-1], last], biases=[*network.biases[:-1], offsets])


@pytest.mark.parametrize("without_biases", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_trees_of_networks_whose_outputs_tie_are_certified(seed: int, without_biases: bool) -> None:
    network = tied(seed, without_biases)
    for tree in (otr.map_network(network), otr.minimal_tree(network, BOX)):
        certificate = otr.certify(tree, network, BOX)
        assert otr.verify(certificate, tree, network) == certificate.max_error < 1e-9
    assert otr.certify(otr.minimal_tree(network), network).max_error < 1e-9


def test_where_outputs_tie_throughout_only_a_sliver_at_a_boundary_may_be_wrong() -> None:
    """max(0, x) > 0 ties for x <= 0: label 1 may begin a little before 0, but not stand alone."""
    network = bump(1.0, 0.0)
    near = otr.ObliqueTree([~0], [~1], [[1.0]], [1e-8], np.zeros((2, 1, 1)), np.zeros((2, 1)), labels=[0, 1],
                           head=otr.Sign())  # fmt: skip
    assert otr.certify(near, network, BOX, max_error=2e-8).max_error == pytest.approx(1e-8)
    assert otr.certify(near, network, max_error=2e-8).max_error == pytest.approx(1e-8)
    with pytest.raises(otr.CertificateError, match="not the same function"):
        otr.certify(leaf_between(-0.5, -0.5 + 1e-8, (1, 0), otr.Sign()), network, BOX)


def corrupted(tree: otr.ObliqueTree, rng: np.random.Generator) -> otr.ObliqueTree:
    """The tree with a shifted or tilted test, or another label at a leaf."""
    labels, v, P = tree.labels.copy(), tree.v.copy(), tree.P.copy()
    way = rng.integers(3) if tree.n_nodes else 0
    if way == 0:
        n_labels, leaf = max(tree.n_outputs, 2), rng.integers(tree.n_leaves)
        labels[leaf] = (labels[leaf] + 1) % n_labels
    else:
        node, size = rng.integers(tree.n_nodes), 10.0 ** -rng.integers(5, 13)
        if way == 1:
            v[node] += size
        else:
            P[node, rng.integers(tree.n_inputs)] += size
    return tree.replace(labels=labels, v=v, P=P)


def check_corrupted(seed: int, head: str, domain: tuple[float, float] | None) -> bool:
    """Return whether a corrupted tree was accepted, after checking that its wrong states are near a tie."""
    rng = np.random.default_rng(seed)
    network = make_network(
        rng, ((3,), (2, 2))[seed % 2], n_inputs=int(rng.integers(1, 3)), n_outputs=1 if head == "sign" else 3,
        head=head, exact=seed % 3 == 0,
    )  # fmt: skip
    tree = corrupted(otr.minimal_tree(network, domain), rng)
    try:
        certificate = otr.certify(tree, network, domain)
    except otr.CertificateError:
        return False
    assert otr.verify(certificate, tree, network) == certificate.max_error
    assert not wrong_states_far_from_a_tie(tree, network, domain, Fraction(certificate.max_error))
    return True


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from(("sign", "argmax")), st.sampled_from((None, BOX, (0.0, 1e3))))
def test_wrong_states_of_what_is_accepted_are_near_a_tie(
    seed: int, head: str, domain: tuple[float, float] | None
) -> None:
    check_corrupted(seed, head, domain)


@pytest.mark.parametrize("head", ["sign", "argmax"])
@pytest.mark.parametrize("constant", [False, True])
def test_trees_with_slivers_at_ties_are_accepted(head: str, constant: bool, tmp_path) -> None:
    d = 3 if constant else 2
    low, high = -np.ones(d), np.ones(d)
    low[1] = 0.5 if constant else -1.0
    high[1] = 0.5 if constant else 1.0
    for seed in range(4):
        network = make_network(
            np.random.default_rng(seed), (3, 2), n_inputs=d, n_outputs=1 if head == "sign" else 3, head=head
        )
        tree = otr.minimal_tree(network, (low, high))
        for shift in (0.0, 1e-10, -1e-10):
            moved = tree.replace(v=tree.v + shift)
            certificate = otr.certify(moved, network, (low, high), max_error=9e-8)
            again = otr.load_certificate(certificate.save(tmp_path / "certificate.json"))
            assert again == certificate and otr.verify(again, moved, network) == certificate.max_error < 1e-7


def test_a_way_that_does_not_lead_to_the_label_is_refused() -> None:
    network = otr.ReluNetwork([[[1.0, 0.5]]], [[0.0]], head=otr.Sign())
    tree = otr.ObliqueTree([~0], [~1], [[1.0, 0.5]], [1e-8], np.zeros((2, 1, 2)), np.zeros((2, 1)), labels=[0, 1],
                           head=otr.Sign())  # fmt: skip
    certificate = otr.certify(tree, network, BOX, max_error=1.1e-8)
    assert 0 < certificate.max_error < 1.1e-8
    at, cell = next((i, cell) for i, cell in enumerate(certificate.cells) if cell.near)
    lies = {
        "no way": replace(cell, towards=()),
        "the other way": replace(cell, towards=(*(-number for number in cell.towards[:-1]), Fraction(0))),
        "out of the box": replace(cell, towards=(3.0, 0.0, 1.0)),
        "too short": replace(cell, towards=cell.towards[1:]),
        "not a number": replace(cell, towards=(float("nan"), *cell.towards[1:])),
        "another piece": replace(cell, near="0"),
        "no piece": replace(cell, near="", proofs=()),
        "no sliver": replace(cell, thin=cell.proofs * 2),
        "no proofs": replace(cell, proofs=tuple(replace(proof, rows=(), multipliers=()) for proof in cell.proofs)),
    }
    for lie in lies.values():
        cells = (*certificate.cells[:at], lie, *certificate.cells[at + 1 :])
        with pytest.raises(otr.CertificateError, match=rf"^leaf {cell.leaf}:"):
            otr.verify(replace(certificate, cells=cells), tree, network)
