"""Minimal trees against counting formulas, brute force and the network itself."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.core.domain import Domain, as_domain
from otr.geometry.arrangement import find_regions
from otr.geometry.minimal_tree import merge_equal_leaves
from tests.core.strategies import Case, cases, make_network, worked_network
from tests.geometry.test_simplex import radius_by_highs

ORDERS = ("layers", "balanced", "visits")


def general_position(n: int, d: int, seed: int = 0) -> otr.ReluNetwork:
    return make_network(np.random.default_rng(seed), (n,), n_inputs=d)


def rounding(X: np.ndarray) -> np.ndarray:
    """What may be rounding of a network's numbers at the states X: some regions are only far away."""
    return 1e-12 * (1 + np.abs(X).max(axis=1))


def assert_same_function(tree: otr.ObliqueTree, network: otr.ReluNetwork, X: np.ndarray) -> None:
    """Values agree to 1e-7; labels wherever no tie is within that; both to within rounding."""
    answers, expected = tree.predict(X), network.predict(X)
    if tree.labels is not None:
        ranked = np.sort(network.forward(X), axis=1)
        gap = np.abs(ranked[:, 0]) if isinstance(network.head, otr.Sign) else np.full(len(X), np.inf)
        if ranked.shape[1] > 1:
            gap = ranked[:, -1] - ranked[:, -2]
        clear = gap > 1e-7 + rounding(X)
        np.testing.assert_array_equal(answers[clear], expected[clear])
        np.testing.assert_array_equal(tree.head(tree.forward(X))[clear], expected[clear])
    else:
        size = 1 + np.abs(expected).max(axis=1, initial=0.0)
        assert (np.abs(answers - expected) <= (1e-7 * size + rounding(X))[:, None]).all()


def assert_same_patterns(network: otr.ReluNetwork, X: np.ndarray, patterns: np.ndarray) -> None:
    """The network has the patterns at X, but for neurons whose pre-activation there is zero to within rounding.

    Such is a neuron that is zero throughout a region: with weights of one digit, some are.
    """
    forms = network.unit_form().forms(patterns, network.negative_slope)[:, : network.n_hidden]
    values = np.einsum("nud,nd->nu", forms, np.column_stack((X, np.ones(len(X)))))
    clear = np.abs(values) > rounding(X)[:, None]
    np.testing.assert_array_equal(values[clear] > 0, patterns[clear])
    np.testing.assert_array_equal(network.patterns(X)[clear], patterns[clear])


def patterns_by_brute_force(network: otr.ReluNetwork, domain: Domain) -> tuple[set[bytes], set[bytes]]:
    """The paths of the full tree whose region HiGHS finds to have an inside, and those it finds to be next to none."""
    tree = otr.map_network(network)
    n_bits = tree.depth
    rows, found, thin = domain.rows(), set(), set()
    for leaf in range(tree.n_leaves):
        node, forms, signs, path = 0, [], [], []
        for bit in range(n_bits):
            right = leaf >> (n_bits - 1 - bit) & 1
            forms.append(np.append(tree.P[node], tree.v[node]))
            signs.append(2 * right - 1)
            path.append(bool(right))
            node = 2 * node + 1 + right
        if n_bits == 0:
            return {b""}, set()
        tests = domain.rows_of(np.array(forms)[None])
        a, b = tests.a[0], tests.b[0]
        flat = ~a.any(axis=1)
        if (np.sign(b[flat]) != np.array(signs)[flat]).any():
            continue
        kept = ~flat
        a, b = np.concatenate((rows.a[0], a[kept])), np.concatenate((rows.b[0], b[kept]))
        signs_of_rows = np.concatenate((np.ones(len(rows.b[0])), np.array(signs)[kept]))
        radius = radius_by_highs(a, b, signs_of_rows)
        if radius > -1e-9:
            (found if radius > 1e-9 else thin).add(np.array(path).tobytes())
    return found, thin


@pytest.mark.parametrize(("n", "d"), [(1, 1), (6, 2), (8, 3), (32, 3), (9, 5), (10, 17), (12, 8)])
def test_hyperplanes_in_general_position_make_as_many_leaves_as_zaslavsky_says(n: int, d: int) -> None:
    network = general_position(n, d)
    tree = otr.minimal_tree(network)
    assert tree.n_leaves == sum(math.comb(n, i) for i in range(min(n, d) + 1))
    assert_same_function(tree, network, np.random.default_rng(1).normal(size=(2000, d)) * 3)


def test_hyperplanes_through_one_point() -> None:
    """Without biases, n hyperplanes in general position make 2 sum_{i < d} C(n - 1, i) cones."""
    for n, d in ((6, 2), (9, 3), (8, 4)):
        network = general_position(n, d, seed=2)
        network = network.replace(biases=[np.zeros(n), [0.0]])
        for domain in (None, (-1.0, 1.0)):
            n_cones = 2 * sum(math.comb(n - 1, i) for i in range(d))
            assert otr.minimal_tree(network, domain).n_leaves == n_cones


def test_an_empty_region_of_an_open_domain_may_stay_undecided() -> None:
    """Its rows meet nowhere, by 0.03, but the proof takes only 1e-6 of the test: kept, without an inner point."""
    weights = [
        [[0.268327, 2.013595, -1.665781, 1.18462], [0.259478, -0.372826, -0.083943, -1.597918],
         [-0.85486, -2.752805, 0.13707, -2.354479]],
        [[-0.495257, -0.583814, 0.456344, -0.240305, -0.373443, 0.348844, 0.482027]],
        [[-0.595402, -0.821244, 0.789056, -0.387005, -1.175344, -1.609736, -0.254557, 0.517099],
         [1.020888, 0.20089, 0.10342, 0.658743, 2.034555, -0.770398, 1.133749, -0.051331]],
        [[-0.682091, -1.195912, 0.748153, -0.758667, -0.103359, 0.26996, 1.808748, 0.974306, -1.874651, -1.977476]],
    ]  # fmt: skip
    biases = [[-0.415875, 0.136494, -0.128031], [0.205315], [0.379556, -0.719224], [-0.311855]]
    network = otr.ReluNetwork(weights, biases, dense="all")
    domain = as_domain(None, 4)
    expected, thin = patterns_by_brute_force(network, domain)
    regions = find_regions(network, domain)
    undecided = np.isnan(regions.inner_points).any(axis=1)
    assert undecided.sum() == 1 and {row.tobytes() for row in regions.patterns[~undecided]} == expected and not thin


@settings(max_examples=60)
@given(cases(max_layers=3), st.booleans())
def test_regions_are_those_of_brute_force(case: Case, in_box: bool) -> None:
    network = case.network
    domain = as_domain((-1.25, 1.5) if in_box else None, network.n_inputs)
    if otr.PatternTree(network).n_bits > 7:
        return
    regions = find_regions(network, domain)
    found = {row.tobytes() for row in regions.patterns}
    assert len(found) == len(regions.patterns)
    expected, thin = patterns_by_brute_force(network, domain)
    undecided = {row.tobytes() for row in regions.patterns[np.isnan(regions.inner_points).any(axis=1)]}
    assert expected <= found and found - undecided <= expected | thin
    assert not in_box or found <= expected | thin
    assert len(found - expected) <= len(undecided)


@given(cases(), st.sampled_from(ORDERS), st.booleans())
def test_computes_the_same_function(case: Case, order: str, in_box: bool) -> None:
    network, X = case.network, case.states
    if in_box:
        X = np.clip(X, -1.0, 1.0)
    domain = (-1.0, 1.0) if in_box else None
    tree = otr.minimal_tree(network, domain, order=order, X=X if order == "visits" else None)
    regions = find_regions(network, as_domain(domain, network.n_inputs))
    assert tree.n_leaves <= len(regions.patterns)
    known = np.isfinite(regions.inner_points).all(axis=1)
    inner = regions.inner_points[known]
    assert_same_patterns(network, inner, regions.patterns[known, : network.n_hidden])
    assert_same_function(tree, network, np.concatenate((X, inner)))
    assert tree.n_leaves - len(np.unique(tree.apply(inner))) <= (~known).sum()


def test_a_neuron_that_is_zero_throughout_a_region_is_inactive_there() -> None:
    """(2 - x) + .5 (2x - 2) - 1 is 0 for -1 < x < 1, but not when computed at x = -.7."""
    network = otr.ReluNetwork([[[-1], [2]], [[1, 1], [1, 0]], [[1, 1]]], [[2, -2], [-1, -2.5], [0]], negative_slope=0.5)
    assert network.patterns([[-0.7], [-0.75]]).tolist() == [[True, False, True, True], [True, False, False, True]]
    regions = find_regions(network, as_domain((-1.0, 1.0), 1))
    assert len(regions.patterns) == 2
    assert not regions.patterns[:, 2].any()
    assert_same_function(otr.minimal_tree(network, (-1.0, 1.0)), network, np.linspace(-1.0, 1.0, 101)[:, None])


def test_no_region_is_found_where_rounding_hides_every_margin() -> None:
    """Four neurons of two layers hang on two: a vertex of almost parallel ones is 1e21 away."""
    network = make_network(np.random.default_rng(112), (3, 3, 2, 2), negative_slope=0.01, head="sign")
    regions = find_regions(network, as_domain(None, 3))
    assert len(regions.patterns) == 225
    assert_same_patterns(network, regions.inner_points, regions.patterns[:, :10])


def test_large_walks_go_block_by_block(monkeypatch: pytest.MonkeyPatch) -> None:
    network = make_network(np.random.default_rng(4), (8, 8), n_inputs=3)
    whole = find_regions(network, as_domain(None, 3)).patterns
    monkeypatch.setattr("otr.geometry.arrangement._BLOCK", 16)
    pieces = find_regions(network, as_domain(None, 3)).patterns
    np.testing.assert_array_equal(np.unique(whole, axis=0), np.unique(pieces, axis=0))


@pytest.mark.parametrize("order", ORDERS)
def test_parallel_duplicate_and_boundary_neurons_add_no_path(order: str) -> None:
    # x - 1 twice, once scaled; its negative; a parallel; and two at the domain's edges.
    W, b = [[1, 0], [3, 0], [-1, 0], [1, 0], [0, 1], [0, 1]], [-1, -3, 1, 0, -2, 2]
    network = otr.ReluNetwork([W, [[1, 2, 3, 4, 5, 6]]], [b, [0]])
    X = np.random.default_rng(0).uniform(-2, 2, (500, 2))
    X[:100, 0], X[100:200, 1], X[200:300, 1] = 1.0, 2.0, -2.0
    tree = otr.minimal_tree(network, (-2.0, 2.0), order=order, X=X if order == "visits" else None)
    assert tree.n_leaves == 3
    assert_same_function(tree, network, X)


def test_leaves_that_count() -> None:
    for apart, n_leaves in ((1e-6, 3), (1e-13, 3), (1e-200, 3), (0.0, 2)):  # not quite equal neurons part the states
        network = otr.ReluNetwork([[[1.0], [1.0]], [[1.0, 1.0]]], [[0.0, apart], [0.0]])
        assert otr.minimal_tree(network).n_leaves == n_leaves
    network = otr.ReluNetwork([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])
    assert otr.minimal_tree(network, ([0.5, -np.inf], [np.inf, 1.0])).n_leaves == 2
    assert otr.minimal_tree(network, ([0.5, -np.inf], [np.inf, -1.0])).n_leaves == 1
    # The second neuron's outgoing weight is zero; the first one is off for x < 0, where both are then the same.
    network = otr.ReluNetwork([[[1.0], [1.0], [2.0]], [[1.0, 0.0, 3.0]]], [[0.0, 5.0, -1.0], [0.0]])
    assert otr.minimal_tree(network).n_leaves == 3
    labelled = otr.ReluNetwork([[[1.0], [1.0]], [[1.0, 0.5], [1.0, 0.5]]], [[0.0, 1.0], [1.0, 0.0]], head=otr.Argmax())
    assert otr.minimal_tree(labelled).n_leaves == 1  # output 0 is larger throughout
    # On both sides of x = 0 the label is 1, though the outputs differ: the merged leaf holds scores that have it.
    tree = otr.minimal_tree(otr.ReluNetwork([[[1.0]], [[1.0], [2.0]]], [[0.0], [0.0, 1.0]], head=otr.Argmax()))
    assert (tree.n_leaves, tree.M.any(), tree.c.tolist(), tree.labels.tolist()) == (1, False, [[0.0, 1.0]], [1])


def test_leaves_are_merged_by_the_size_of_each_number() -> None:
    # Beside 1e6 times the second input, 1e-7 times the first seems nothing; but the first is up to 1e7.
    network = otr.ReluNetwork([[[1.0, 0], [0, 1.0], [0, -1.0]], [[1e-7, 1e6, -1e6]]], [[0.0] * 3, [0.0]])
    for order in ("layers", "balanced"):
        tree = otr.minimal_tree(network, ([-1e7, -1e-6], [1e7, 1e-6]), order=order)
        assert (tree.n_leaves, tree.predict([1e7, 0.0]).tolist()) == (2, [1.0])
    # What a leaky unit adds on one side and a second takes away leaves rounding in the place of 0.
    W = np.array([[0.1, 0.3], [0.1, 0.3]])
    cancelling = otr.ReluNetwork([W, [[0.3, -0.1 - 0.2]]], [[0.7, 0.7], [1.0]], negative_slope=0.1)
    tree = otr.map_network(cancelling)
    assert np.abs(tree.M[0] - tree.M[-1]).max() > 0
    assert otr.minimal_tree(cancelling).n_leaves == 1


def test_a_constant_test_in_a_region_without_an_inner_point_goes_its_way() -> None:
    W = [[-1.025, 0.677, -0.508, 0.543], [0.44, 0.213, 1.271, -0.065], [0.339, 0.171, -0.462, 1.98],
         [-0.853, -1.504, 0.965, -0.341], [0.853, 1.504, -0.965, 0.341]]  # fmt: skip
    biases = [[0.132, -0.072, -0.192, -0.373, 0.373], [-4.4], [0.0]]
    network = otr.ReluNetwork([W, [[-1.2, 0.2, -0.3, -0.6, -1.4]], [[1.0]]], biases)
    tree = otr.minimal_tree(network, (-np.ones(4), np.ones(4)))
    assert (tree.n_leaves, tree.predict(np.zeros(4)).tolist()) == (1, [0.0])
    assert otr.certify(tree, network, (-np.ones(4), np.ones(4))).max_error == 0.0


def test_merging_reaches_up_the_tree() -> None:
    full = otr.map_network(worked_network())

    def merged(tree: otr.ObliqueTree) -> otr.ObliqueTree:
        return merge_equal_leaves(tree, lambda leaves: np.abs(tree.leaf_forms[leaves]))

    same = full.replace(M=np.ones_like(full.M), c=np.ones_like(full.c))
    assert merged(same).n_leaves == 1
    uneven = same.replace(c=same.c + np.eye(8)[:, :1])
    X = np.random.default_rng(0).normal(size=(500, 2))
    np.testing.assert_array_equal(merged(uneven).predict(X), uneven.predict(X))
    assert merged(uneven).n_leaves == 4  # leaf 0 and the three subtrees that hang off its path


@pytest.mark.parametrize("dense", [False, "input", "all"])
def test_dead_neurons_are_left_out(dense: str | bool) -> None:
    network = make_network(np.random.default_rng(5), (4, 3, 2), n_inputs=2, dense=dense)
    weights = [W.copy() for W in network.weights]
    for W in weights[1:] if dense == "all" else weights[3:]:
        W[:, 0] = 0.0  # the outputs read the third layer's first neuron no more: of "all", the first layer's
    network = network.replace(weights=weights)
    smaller, X = network.without_dead_neurons(), np.random.default_rng(0).normal(size=(100, 2))
    assert smaller.n_hidden == 8
    np.testing.assert_allclose(smaller.forward(X), network.forward(X))


def test_orders_shorten_the_paths() -> None:
    network, X = general_position(12, 2), np.random.default_rng(1).normal(size=(4000, 2)) / 2
    trees = {order: otr.minimal_tree(network, order=order, X=X if order == "visits" else None) for order in ORDERS}
    n_tests = {order: tree.decision_path(X).sum() / len(X) for order, tree in trees.items()}
    assert {tree.n_leaves for tree in trees.values()} == {79}
    assert n_tests["visits"] < n_tests["balanced"] < n_tests["layers"]
    assert trees["balanced"].depth < trees["layers"].depth


def test_bad_requests_and_limits_are_reported() -> None:
    network, large = worked_network(), general_position(24, 6)
    for error, words, options in (
        (ValueError, "order is 'best', expected", {"order": "best"}),
        (ValueError, "needs states X", {"order": "visits"}),
        (ValueError, "the domain has 3 inputs, expected 2", {"domain": ([0, 0, 0], [1, 1, 1])}),
        (ValueError, "input 1 has the limits 1 and 0", {"domain": ([0, 1], [1, 0])}),
        (otr.TreeTooLargeError, r"limit of 1,000 regions was met.* test \d+ of 24.*raise", {"max_leaves": 1000}),
        (otr.TreeTooLargeError, r"limit of 0 s was met.*raise the limit", {"max_seconds": 0.0}),
    ):
        with pytest.raises(error, match=words):
            otr.minimal_tree(large if error is otr.TreeTooLargeError else network, **options)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_box_of_one_state_has_its_leaf(size: float) -> None:
    layers = [[[1.0], [-2.0]], [[1.0, 3.0], [2.0, -1.0]], [[1.0, 1.0]]]
    weights = [size * np.array(layer) for layer in layers[:2]]
    network = otr.ReluNetwork([*weights, layers[2]], [[1.0, 2.0], [0.5, 1.0], [0.0]])
    tree = otr.minimal_tree(network, ([1.8], [1.8]))
    assert tree.n_leaves == 1 and otr.certify(tree, network, ([1.8], [1.8]), max_error=size**2).max_error < size**2
    np.testing.assert_allclose(tree.predict([[1.8]]), network.predict([[1.8]]), rtol=1e-12)
