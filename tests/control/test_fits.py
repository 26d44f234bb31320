import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.tree import DecisionTreeClassifier

import otr
from otr.control import AugTreeFit, CartFit, LinearModelTreeFit
from otr.control.features.binned import quantised, with_thresholds_between
from otr.control.features.hidden_units import AffineFeatures, deep_features, first_layer_features, unit_forms
from otr.control.features.screening import best_columns
from otr.learners import LinearTreeRegressor, from_sklearn_tree
from tests.core.strategies import make_network


def generator():
    return np.random.default_rng(0)


def oblique_oracle():
    W = np.array([[3.0, 4.0, 0.0], [4.0, -3.0, 1.0]]) / 5
    out = np.array([[0.0, 0.0, 0.0, 0.0], [2.0, -2.0, 0.0, 0.0], [0.0, 0.0, 2.0, -2.0], [1.0, -1.0, 1.0, -1.0]])
    return otr.ReluNetwork(
        [np.concatenate((W[:1], -W[:1], W[1:], -W[1:])), out], [np.zeros(4), np.zeros(4)], head=otr.Argmax()
    )


def labelled(oracle, n=4000, seed=0):
    X = np.random.default_rng(seed).normal(size=(n, oracle.n_inputs))
    outputs = oracle.forward(X)
    return X, outputs, outputs.max(axis=1) - outputs.min(axis=1)


def accuracy(tree, oracle):
    X = np.random.default_rng(99).normal(size=(4000, oracle.n_inputs))
    return (tree.predict(X) == oracle.predict(X)).mean()


ALL_FITS = [
    CartFit(3),
    CartFit(3, max_samples=500),
    LinearModelTreeFit(otr.Argmax(), 2),
    AugTreeFit(oblique_oracle(), 3, max_samples=3000),
    AugTreeFit(oblique_oracle(), 3, weighted=True),
    AugTreeFit(oblique_oracle(), 2, leaves="linear", max_samples=3000),
]


@pytest.mark.parametrize("fit", ALL_FITS, ids=lambda fit: type(fit).__name__)
def test_fits_are_deterministic_and_draw_from_the_generator(fit):
    X, outputs, weights = labelled(oblique_oracle())
    first, again, other = (fit(X, outputs, weights, np.random.default_rng(seed)) for seed in (0, 0, 1))
    for name in ("P", "v", "M", "c", "labels"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.array_equal(first.v, other.v)


def test_cart_follows_the_weights():
    """The label of rows of weight 0 is never learned; of those that weigh, all are."""
    X = np.linspace(0, 1, 2000)[:, None]
    outputs = np.zeros((2000, 3))
    outputs[X[:, 0] < 0.5, 2] = 1.0
    tree = CartFit(1)(X, outputs, (X[:, 0] > 0.4).astype(float), generator())
    assert tree.n_outputs == 3
    assert tree.labels.tolist() == [2, 0]
    assert -tree.v[0] == pytest.approx(0.5, abs=0.005)
    assert CartFit(1)(X, outputs, (X[:, 0] > 0.6).astype(float), generator()).labels.tolist() == [0]


def test_outputs_of_a_linear_model_tree_are_centred():
    """What is added to all outputs of a state changes no label, and so has to change no tree."""
    X, outputs, weights = labelled(oblique_oracle())
    shifted = outputs + 1e3 * np.sin(50 * X[:, :1])
    fit = LinearModelTreeFit(otr.Argmax(), 3)
    trees = [fit(X, values, weights, generator()) for values in (outputs, shifted)]
    assert (trees[0].predict(X) == trees[1].predict(X)).mean() > 0.999
    assert accuracy(trees[0], oblique_oracle()) > 0.9
    linear = otr.ReluNetwork([[[1.0, -2.0], [0.5, 1.0], [-1.0, 0.0]]], [[0.1, 0.0, -0.2]], head=otr.Argmax())
    data = labelled(linear)
    assert accuracy(LinearModelTreeFit(otr.Argmax(), 0)(*data, generator()), linear) > 0.999
    assert accuracy(CartFit(3)(*data, generator()), linear) < 0.95


def test_continuous_actions_are_clipped_to_the_oracles_box():
    X = np.random.default_rng(0).normal(size=(2000, 2))
    head = otr.TanhBox([-2.0, -1.0], [2.0, 3.0])
    actions = head(3 * X)
    tree = LinearModelTreeFit(head, 3)(X, actions, None, generator())
    assert tree.head == otr.ClipBox([-2.0, -1.0], [2.0, 3.0])
    assert np.abs(tree.predict(X) - actions).mean() < 0.16
    assert np.abs(CartFit(3)(X, actions, None, generator()).predict(X) - actions).mean() > 0.25
    with pytest.raises(TypeError, match="Identity"):
        LinearModelTreeFit(otr.Identity(), 3)(X, actions, None, generator())


def test_augtree_answers_like_an_oblique_oracle_where_cart_cannot():
    oracle = oblique_oracle()
    data = labelled(oracle)
    rows = [*oracle.weights[0].tolist(), *np.eye(3).tolist()]
    for features, tests in (("all", rows), ("z", rows[:4])):
        tree = AugTreeFit(oracle, 4, features=features)(*data, generator())
        assert accuracy(tree, oracle) > 0.95 and len(tree.P) > 0 and all(test in tests for test in tree.P.tolist())
    assert accuracy(CartFit(4)(*data, generator()), oracle) < 0.93


def test_linear_leaves_read_x_alone_and_lie_below_the_oracles_tests():
    """An oracle of one hidden neuron is two planes: one test of its own, two affine leaves."""
    oracle = otr.ReluNetwork([[[3.0, 4.0, 1.0]], [[2.0]]], [[0.5], [-1.0]], head=otr.ClipBox(-50.0, 50.0))
    X = np.random.default_rng(0).normal(size=(3000, 3))
    tree = AugTreeFit(oracle, 1, leaves="linear")(X, oracle.predict(X), None, generator())
    assert tree.P.tolist() == [[3.0, 4.0, 1.0]]
    assert np.abs(tree.predict(X) - oracle.predict(X)).max() < 0.05
    np.testing.assert_allclose(tree.M[1, 0], [6, 8, 2], rtol=1e-3)


@given(
    seed=st.integers(0, 2**32 - 1),
    widths=st.sampled_from([(3, 2), (4, 3, 2)]),
    dense=st.sampled_from([False, "input", "all"]),
    slope=st.sampled_from([0.0, 0.1]),
)
def test_deep_features_are_the_networks_own_on_rows_of_their_pattern(seed, widths, dense, slope):
    rng = np.random.default_rng(seed)
    network = make_network(rng, widths, dense=dense, negative_slope=slope)
    X = rng.normal(size=(60, 3)) * 2
    patterns = network.patterns(X)
    forms, offsets = unit_forms(network, patterns, network.n_hidden)
    z = np.einsum("nkd,nd->nk", forms, X) + offsets
    activations, read = X, X
    start, made = 0, []
    for layer, width in enumerate(widths):
        z_layer = read @ network.weights[layer].T + network.biases[layer]
        np.testing.assert_allclose(z[:, start : start + width], z_layer, atol=1e-9)
        activations = np.maximum(z_layer, slope * z_layer)
        made.append(activations)
        read = {False: activations, "input": np.hstack((activations, X)), "all": np.hstack((*made, X))}[dense]
        start += width
    # Every row whose pattern is among the most frequent finds its z_2 among the features.
    deep = deep_features(network, X, 2)
    values = X @ deep.A.T + deep.a
    seen, counts = np.unique(patterns[:, : widths[0]], axis=0, return_counts=True)
    n_patterns = min(2, len(seen))
    for row in np.flatnonzero((patterns[:, : widths[0]] == seen[counts.argmax()]).all(axis=1)):
        blocks = values[row, : n_patterns * widths[1]].reshape(n_patterns, widths[1])
        assert np.abs(blocks - z[row, widths[0] : sum(widths[:2])]).max(axis=1).min() < 1e-9


def test_the_most_frequent_patterns_come_first_and_features_that_repeat_or_never_change_are_dropped():
    network = otr.ReluNetwork([[[1.0]], [[5.0]], [[1.0]]], [[0.0], [1.0], [0.0]])
    X = np.array([[-1.0], [2.0], [3.0]])
    assert deep_features(network, X, 1).A.tolist() == [[5.0]]  # active in two of three
    assert deep_features(network, X, 2).A.tolist() == [[5.0], [0.0]]
    assert deep_features(network, -X, 1).A.tolist() == [[0.0]]
    A = np.array([[1.0, 2.0], [0.0, 0.0], [-2.0, -4.0], [1.0, 2.1], [0.0, -3.0], [0.0, 1.0]])
    assert AffineFeatures(A, np.arange(6.0)).distinct().a.tolist() == [0, 3, 4]
    features = first_layer_features(oblique_oracle(), include_inputs=True).distinct()
    assert len(features.A) == 5  # x, and two of the four neurons, of which two are mirrored


@given(seed=st.integers(0, 2**32 - 1), features=st.sampled_from(["all", "z", "deep"]), discrete=st.booleans())
def test_the_tree_on_x_is_the_tree_on_the_features(seed, features, discrete):
    rng = np.random.default_rng(seed)
    network = make_network(rng, (5, 4), n_outputs=3, head="argmax" if discrete else "clip_box")
    X = rng.normal(size=(300, 3))
    fit = AugTreeFit(network, 4, features=features, max_samples=300)
    answers = network.forward(X) if discrete else network.predict(X)
    tree = fit(X, answers, np.ones(300) if discrete else None, np.random.default_rng(1))
    if features == "deep" and discrete:  # its patterns are those of the drawn rows
        return
    A, a = fit._features(X).A, fit._features(X).a
    unit = np.array([np.abs(A - P).sum(axis=1).argmin() for P in tree.P], dtype=int)
    np.testing.assert_allclose(tree.P, A[unit], atol=1e-9)
    on_features = X @ A.T + a
    thresholds = a[unit] - tree.v
    size = max(1, np.abs(on_features).max())
    np.testing.assert_allclose(X @ tree.P.T + tree.v, on_features[:, unit] - thresholds, atol=1e-9 * size)
    # A threshold lies among the values of its feature, so that both sides have rows.
    assert ((thresholds > on_features[:, unit].min(axis=0)) & (thresholds < on_features[:, unit].max(axis=0))).all()
    assert np.bincount(tree.apply(X), minlength=tree.n_leaves).min() >= (0 if discrete else 1)


def test_bins_keep_the_order_and_thresholds_part_the_rows_alike():
    rng = np.random.default_rng(0)
    values = np.stack((rng.standard_cauchy(5000), rng.integers(0, 2, 5000), np.full(5000, 3.0), rng.normal(size=5000)))
    values = values.astype(np.float32)
    bins = quantised(values)
    for feature in range(4):
        order = values[feature].argsort(kind="stable")
        assert (np.diff(bins[order, feature]) >= 0).all()
    n_bins = [len(np.unique(bins[:, feature])) for feature in (1, 2, 3)]
    assert n_bins[:2] == [2, 1] and n_bins[2] > 200 and np.bincount(bins[:, 3].astype(int)).max() < 60
    y = ((values[3] > 0.3) ^ (values[1] > 0)).astype(int)
    model = DecisionTreeClassifier(max_depth=4, random_state=0).fit(bins, y)
    tree = with_thresholds_between(from_sklearn_tree(model), bins, values)
    np.testing.assert_array_equal(tree.predict(values.T.astype(float)), model.predict(bins))
    np.testing.assert_array_equal(tree.v[np.flatnonzero(tree.P[:, 1])], -0.5)
    assert (tree.predict(values.T.astype(float)) == y).mean() > 0.99
    outlier = rng.normal(size=(2, 5_000)).astype(np.float32)
    plain = quantised(outlier)
    outlier[:, 0] = 1e6, 1e30
    bins = quantised(outlier)
    assert (np.bincount(bins[:, 0].astype(int)).max() <= 2 * 5_000 / 255) and bins[0].min() == 254
    assert np.corrcoef(bins[1:, 0], plain[1:, 0])[0, 1] > 0.999
    few = quantised(np.repeat(np.arange(3, dtype=np.float32), 5)[None])
    assert np.unique(few[:, 0], return_counts=True)[1].tolist() == [5, 5, 5]


def test_screening_keeps_the_feature_at_which_the_planes_part():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(6000, 3))
    directions = rng.normal(size=(150, 3))
    S = X @ directions.T
    Y = np.where(S[:, [77]] <= 0.2, X[:, [0]], 3 - X[:, [1]])
    Z = Y - Y.mean()
    columns = best_columns(S, X, Z, LinearTreeRegressor(), 8)
    assert 77 in columns
    assert len(columns) == 8
    assert best_columns(S[:, :5], X, Z, LinearTreeRegressor(), 8).tolist() == [0, 1, 2, 3, 4]


def test_entropy_sets_a_rare_label_apart_and_gini_parts_the_frequent_ones():
    labels = np.repeat([0, 1, 2], [1000, 1000, 100])
    X = np.zeros((2100, 2))  # x_0 sets the rare label 2 apart; x_1 parts the labels 0 and 1, 70 to 30
    X[labels == 2, 0] = 1.0
    X[np.r_[0:700, 1000:1300, 2000:2050], 1] = 1.0
    oracle = otr.ReluNetwork([[[1.0, 0.0]], np.ones((3, 1))], [[0.0], np.zeros(3)], head=otr.Argmax())
    for criterion, test in (("entropy", [[1.0, 0.0]]), ("gini", [[0.0, 1.0]])):
        for fit in (AugTreeFit(oracle, 1, criterion=criterion), CartFit(1, criterion=criterion)):
            assert fit(X, np.eye(3)[labels], np.ones(2100), generator()).P.tolist() == test
    assert AugTreeFit(oracle, 1).criterion == "entropy"


@pytest.mark.parametrize("leaves", ["constant", "linear", "viper's"])
def test_rows_are_drawn_by_weight_only_if_asked(leaves):
    """Rows of weight 0 hold the label 1, the others the label 0."""
    oracle = otr.ReluNetwork([[[1.0]], [[-1.0], [1.0]]], [[0.0], [0.0, -0.5]], head=otr.Argmax())
    X = np.linspace(-1, 1, 1000)[:, None]
    outputs = oracle.forward(X)
    weights = (outputs.argmax(axis=1) == 0).astype(float)

    def answers(is_weighted):
        viper = leaves == "viper's"
        fit = CartFit(3, weighted=is_weighted) if viper else AugTreeFit(oracle, 3, leaves=leaves, weighted=is_weighted)
        return fit(X, outputs, weights, generator()).predict(X)

    assert (answers(False) == outputs.argmax(axis=1)).mean() > 0.99
    assert (answers(True) == 0).all() or (leaves == "linear" and (answers(True) != answers(False)).any())


def test_errors():
    linear, oracle = otr.ReluNetwork([np.ones((2, 2))], [np.zeros(2)], head=otr.Argmax()), oblique_oracle()
    for make, words in (
        (lambda: AugTreeFit(linear, 3), "at least 1 hidden layers, this one has 0"),
        (lambda: AugTreeFit(oracle, 3, features="deep"), "at least 2 hidden layers, this one has 1"),
        (lambda: AugTreeFit(oracle, 3, features="x"), "features=x: use one of all, z, deep"),
        (lambda: AugTreeFit(oracle, 3, criterion="mse"), "criterion=mse: use one of gini, entropy"),
        (lambda: CartFit(3, criterion="mse"), "criterion=mse: use one of gini, entropy"),
    ):
        with pytest.raises(ValueError, match=words):
            make()
