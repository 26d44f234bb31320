"""Trees with a single number or label changed: what is accepted is true at every point of every leaf."""

from collections.abc import Iterable
from fractions import Fraction

import numpy as np
import pytest

import otr
from otr.core.domain import as_domain
from otr.proof.exact_cells import cells_of_leaf, largest_gap
from otr.proof.exact_rows import TreeAndNetwork
from tests.core.strategies import make_network
from tests.proof.labels import wrong_states_far_from_a_tie

BOXES = ((-1.0, 1.0), (-2.0, 2.0), None, (-1e4, 1e4))
HEADS = ("identity", "tanh_box", "argmax", "sign", "clip_box", "exp")


def network_of(rng: np.random.Generator, k: int) -> otr.ReluNetwork:
    """One or two layers, dense links, leaky; every fourth with nearly parallel neurons."""
    head = HEADS[k % 6]
    n_inputs, n_outputs = int(rng.integers(1, 4)), {"argmax": 3, "sign": 1}.get(head, int(rng.integers(1, 4)))
    widths = (int(rng.integers(2, 6)),) if k % 2 else (int(rng.integers(2, 4)), int(rng.integers(2, 4)))
    network = make_network(
        rng, widths, n_inputs=n_inputs, n_outputs=n_outputs, head=head, dense=(False, "input", "all")[k % 3],
        negative_slope=(0.0, 0.01, 0.5)[k // 2 % 3], exact=k % 7 == 0,
    )  # fmt: skip
    if k % 4:
        return network
    weights, biases = [W.copy() for W in network.weights], [b.copy() for b in network.biases]
    weights[0][1] = weights[0][0] + 10.0 ** -rng.integers(6, 16) * rng.integers(-3, 4, n_inputs)
    biases[0][1] = biases[0][0]
    return otr.ReluNetwork(
        weights, biases, negative_slope=network.negative_slope, dense=network.dense, head=network.head
    )


def changed(rng: np.random.Generator, tree: otr.ObliqueTree) -> otr.ObliqueTree:
    """The tree with another label, or a number scaled, turned round, zeroed, shifted or moved by its last bit."""
    arrays = {name: getattr(tree, name).copy() for name in ("P", "v", "M", "c")}
    labels = None if tree.labels is None else tree.labels.copy()
    names = [name for name, array in arrays.items() if array.size]
    name = names[rng.integers(len(names))] if labels is None else ("P", "v", "labels")[rng.integers(3)]
    if labels is not None and (name == "labels" or not arrays[name].size):
        leaf, n_labels = rng.integers(len(labels)), max(tree.n_outputs, 2)
        labels[leaf] = (labels[leaf] + 1 + rng.integers(n_labels - 1)) % n_labels
    else:
        numbers = arrays[name].reshape(-1)
        at = rng.integers(numbers.size)
        x = numbers[at]
        ways = (x * (1 + 10.0 ** -rng.integers(1, 17)), -x, 0.0, x + 10.0 ** -rng.integers(0, 15), np.nextafter(x, 9e9))
        numbers[at] = ways[rng.integers(len(ways))]
    return otr.ObliqueTree(tree.children_left, tree.children_right, *arrays.values(), labels=labels, head=tree.head)


def gaps(tree: otr.ObliqueTree, network: otr.ReluNetwork, box: tuple[float, float] | None) -> list[Fraction]:
    """Differences, in the units of the bound, at a point of every cell in every leaf, and next to where they peak."""
    pair = TreeAndNetwork(tree, network, as_domain(box, network.n_inputs))
    found = []
    for leaf in range(tree.n_leaves):
        for cell in cells_of_leaf(pair, leaf):
            corners = [point for points, _ in largest_gap(pair, cell) for point in points]
            nearer = [
                tuple(a + (b - a) / 2**k for a, b in zip(corner, cell.point, strict=True))
                for corner in corners
                for k in (40, 3)
            ]
            for point in (cell.point, *nearer):
                reached, gap = pair.gap(point)
                if reached == leaf:
                    found.append(gap / pair.unit_at(point))
    return found


def check_changes(k: int, n_changes: int) -> tuple[int, int]:
    """Return how many changed trees of network k were accepted, and how many refused, after checking each."""
    rng = np.random.default_rng(k)
    network, box = network_of(rng, k), BOXES[k // 3 % 4]
    tree = otr.minimal_tree(network, box) if k % 2 else otr.map_network(network)
    certificate = otr.certify(tree, network, box)
    n_accepted = n_refused = 0
    for _ in range(n_changes):
        other, bounds = changed(rng, tree), []
        for given in ((certificate, other, network), (other, network, box)):
            try:
                proved = otr.verify(*given) if given[0] is certificate else otr.certify(*given).max_error
                bounds.append(Fraction(proved))
            except otr.CertificateError as error:
                assert error.leaf is not None
                if error.state is not None:
                    pair = TreeAndNetwork(other, network, certificate.domain)
                    leaf, gap = pair.gap(error.state)
                    assert pair.is_inside(error.state) and leaf == error.leaf and gap > 0
        n_accepted, n_refused = n_accepted + bool(bounds), n_refused + (not bounds)
        if bounds:
            if tree.labels is None:
                assert max(gaps(other, network, box)) <= min(bounds)
            else:
                assert not wrong_states_far_from_a_tie(other, network, box, min(bounds))
    return n_accepted, n_refused


@pytest.mark.parametrize(
    ("networks", "n"), [((0, 1, 2, 3, 5, 6, 7), 2), pytest.param(range(50), 100, marks=pytest.mark.slow)]
)  # network 4 alone takes as long as the quick ones
def test_changes_that_are_accepted_are_true(networks: Iterable[int], n: int) -> None:
    counts = np.array([check_changes(k, n) for k in networks])
    assert (counts.sum(axis=0) > n).all() and (counts.sum(axis=1) == n).all()
