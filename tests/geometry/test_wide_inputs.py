"""Minimal trees of many inputs cost what their few first-layer neurons do."""

import tracemalloc

import numpy as np
import pytest

import otr
from otr.core.domain import Domain, as_domain
from otr.core.pruning import keep_leaves
from otr.geometry.arrangement import find_regions
from tests.core.strategies import make_network


def test_a_tree_of_784_inputs_takes_little_memory() -> None:
    network = make_network(np.random.default_rng(0), (6, 4), n_inputs=784, n_outputs=10)
    tracemalloc.start()
    tree = otr.minimal_tree(network)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6  # the leaves' maps alone, written out, are 30 MB
    X = np.random.default_rng(1).normal(size=(500, 784))
    np.testing.assert_allclose(tree.predict(X), network.predict(X), atol=1e-9)
    np.testing.assert_allclose(tree.predict(X[0]), network.predict(X[0]), atol=1e-9)
    assert len(np.unique(tree.apply(find_regions(network, as_domain(None, 784)).inner_points))) == tree.n_leaves
    assert (tree.P.shape, tree.M.shape) == ((tree.n_nodes, 784), (tree.n_leaves, 10, 784))
    np.testing.assert_allclose(
        np.einsum("noi,ni->no", tree.M[tree.apply(X)], X) + tree.c[tree.apply(X)], tree.forward(X), atol=1e-9
    )


def test_a_box_of_452_inputs_takes_little_memory() -> None:
    network = make_network(np.random.default_rng(0), (8,), n_inputs=452, n_outputs=4)
    tracemalloc.start()
    tree = otr.minimal_tree(network, (-1.0, 1.0))
    certificate = otr.certify(tree, network, (-1.0, 1.0))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 150e6  # bases of 453 rows each, for every region, are 420 MB
    assert tree.n_leaves == certificate.n_regions == 2**8
    assert otr.verify(certificate, tree, network) == certificate.max_error < 1e-14


def test_a_tree_in_a_basis_is_a_tree_like_any_other(tmp_path) -> None:
    network = make_network(np.random.default_rng(0), (4,), n_inputs=70, n_outputs=3, head="argmax")
    tree = otr.minimal_tree(network)
    assert tree.basis.shape == (4, 70)
    X = np.random.default_rng(1).normal(size=(300, 70))
    again = otr.load(otr.save(tree, tmp_path / "tree"))
    np.testing.assert_array_equal(again.predict(X), tree.predict(X))
    kept = keep_leaves(tree, np.arange(tree.n_leaves) % 2 == 0)
    plain = keep_leaves(again, np.arange(tree.n_leaves) % 2 == 0)
    np.testing.assert_allclose(kept.forward(X), plain.forward(X), atol=1e-9)
    assert kept.decision_path(X).nnz == plain.decision_path(X).nnz
    certificate = otr.certify(tree, network)
    assert certificate.max_error < 1e-11
    assert otr.verify(certificate, again, network) == certificate.max_error
    with pytest.raises(otr.InvalidTreeError, match=r"basis has shape \(3, 70\), expected \(4, n_inputs\)"):
        tree.replace(P=tree.P_of_basis, M=tree.M_of_basis, basis=np.ones((3, 70)))
    with pytest.raises(otr.TreeTooLargeError, match="limit of 2,000 regions"):
        otr.minimal_tree(make_network(np.random.default_rng(0), (12, 12), n_inputs=784), max_leaves=2000)


@pytest.mark.parametrize("dense", [False, "input"])
@pytest.mark.parametrize("n_boxed", [0, 2])
def test_few_products_of_open_inputs_stand_for_them(dense: object, n_boxed: int) -> None:
    """The same regions as with the inputs themselves, which the walk takes where they are not more than the units."""
    network = make_network(np.random.default_rng(3), (3, 2), n_inputs=9, dense=dense)
    low, high = np.full(9, -np.inf), np.full(9, np.inf)
    low[:n_boxed], high[:n_boxed] = -1.0, 1.0
    regions = find_regions(network, Domain(low, high))
    inner = regions.inner_points
    assert ((inner > low) & (inner < high)).all()
    np.testing.assert_array_equal(network.patterns(inner), regions.patterns)
    nearly_all = find_regions(network, Domain(np.where(np.isinf(low), -1e9, low), np.where(np.isinf(high), 1e9, high)))
    assert {row.tobytes() for row in regions.patterns} == {row.tobytes() for row in nearly_all.patterns}
