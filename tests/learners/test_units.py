"""Trees do not depend on the units of inputs and targets, which scikit-learn's splitter resolves in few of."""

import warnings
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor

import otr
from otr.control.augtree import AugTreeFit
from otr.control.ndps import NdpsSettings, fit_ndps
from otr.control.viper import CartFit
from otr.learners import (
    AugTreeClassifier,
    AugTreeRegressor,
    CARTClassifier,
    CARTRegressor,
    HHCARTClassifier,
    TAOClassifier,
    from_sklearn_tree,
)
from otr.learners.base.column_units import Units
from otr.learners.distillation import Teacher, fit_teacher

RNG = np.random.default_rng(0)
X, FRESH = RNG.uniform(1, 8, (2, 200, 2))
Y = (X.sum(axis=1) > 9).astype(int)
SCALES = [*10.0 ** -np.arange(5, 13), 1e-30, 1e9, 1e60]
NETWORK = {"network": otr.ReluNetwork([[[1.0, 1.0]], [[1.0]]], [[-9.0], [0.0]])}


@pytest.mark.parametrize(
    ("model", "alike"),
    [
        (CARTClassifier(random_state=0), 1.0),
        (CARTClassifier(max_depth=4, random_state=0), 1.0),
        (AugTreeClassifier(max_depth=2, mlp_max_iter=50, random_state=0), 0.99),
        (HHCARTClassifier(random_state=0), 1.0),
        (TAOClassifier(max_depth=3, random_state=0), 0.97),  # its penalty is in the units in which it fits
    ],
    ids=lambda model: type(model).__name__ if hasattr(model, "fit") else "",
)
def test_classes_do_not_depend_on_the_unit_of_the_inputs(model, alike):
    model.fit(X, Y)
    score, expected = model.score(X, Y), model.predict(FRESH)
    assert score > 0.9
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scale in SCALES:
            model.fit(X * scale, Y)
            assert model.score(X * scale, Y) >= score - (1 - alike), scale
            assert (model.predict(FRESH * scale) == expected).mean() >= alike, scale


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e-12, 1e-60, 1e60])
@pytest.mark.parametrize("shift", [0.0, 1e9])
def test_values_do_not_depend_on_the_units_of_the_targets(scale, shift):
    targets = np.column_stack((X.sum(axis=1), Y, np.full(len(X), 3.0)))
    for model in (CARTRegressor(max_leaf_nodes=9, random_state=0), AugTreeRegressor(max_depth=3, **NETWORK)):
        expected = model.fit(X, targets).predict(FRESH)
        shifted = (targets + shift) * scale
        found = model.fit(X * 1e-9, shifted).predict(FRESH * 1e-9) / scale - shift
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 if shift else 1e-12)


def test_pruning_by_cost_is_in_the_units_of_the_targets():
    for scale in (1.0, 2.0**-40):
        model = CARTRegressor(ccp_alpha=0.01 * scale**2, random_state=0).fit(X, Y * scale)
        assert model.get_n_leaves() == CARTRegressor(ccp_alpha=0.01, random_state=0).fit(X, Y).get_n_leaves() > 2


@pytest.mark.parametrize("start", [1.7e9, 1.7e12, -1e6])
def test_times_far_from_0_are_told_apart(start):
    time = start + np.arange(400.0)[:, None]
    period = (np.arange(400) % 20 < 10).astype(int)
    assert Units.of(time).shift.tolist() == [start]
    for model in (CARTClassifier(), TAOClassifier(max_depth=None), AugTreeClassifier(mlp_max_iter=5, random_state=0)):
        assert model.fit(time, period).score(time, period) == 1.0, model
    assert CARTRegressor().fit(time, period).score(time, period) == 1.0
    random = TAOClassifier(max_depth=2, init="random", random_state=0).fit(time, time[:, 0] > start + 100)
    assert random.score(time, time[:, 0] > start + 100) > 0.97
    tree = CARTClassifier(max_depth=1).fit(time, np.arange(400) >= 100).tree_
    assert tree.P.tolist() == [[1.0]] and tree.v.tolist() == [-start - 99.5]


@given(
    seed=st.integers(0, 2**32 - 1),
    exponents=st.lists(st.integers(-200, 200), min_size=3, max_size=3),
    of_targets=st.integers(-200, 200),
)
def test_powers_of_two_leave_the_structure(seed, exponents, of_targets):
    rng = np.random.default_rng(seed)
    rows, values = np.round(rng.normal(size=(60, 3)), 3), np.round(rng.normal(size=(60, 2)), 3)
    scale = np.ldexp(1.0, exponents)
    plain = CARTRegressor(random_state=0).fit(rows, values).tree_
    scaled = CARTRegressor(random_state=0).fit(rows * scale, np.ldexp(values, of_targets)).tree_
    np.testing.assert_array_equal(scaled.children_left, plain.children_left)
    np.testing.assert_array_equal(scaled.P, plain.P)
    np.testing.assert_allclose(scaled.v, plain.v * (plain.P @ scale), rtol=1e-6)  # thresholds lie between float32s
    np.testing.assert_array_equal(scaled.apply(rows * scale), plain.apply(rows))
    np.testing.assert_allclose(np.ldexp(scaled.c, -of_targets), plain.c, rtol=0, atol=1e-12)


@given(
    low=st.floats(-1e12, 1e12),
    steps=st.lists(st.integers(1, 2**30), min_size=2, max_size=40, unique=True),
)
def test_thresholds_part_neighbouring_numbers(low, steps):
    column = np.unique(low + np.array(steps) * np.spacing(abs(low) + 1.0))[:, None]
    if np.ptp(column) <= 1e-11 * np.abs(column).max():
        return
    units = Units.of(column)
    changed = units.changed(column)
    assert np.array_equal(units.restored(changed), column)
    for at in range(len(column) - 1):
        middle = changed[at, 0] / 2 + changed[at + 1, 0] / 2
        tree = otr.ObliqueTree([~0], [~1], [[1.0]], [-middle], np.zeros((2, 1, 1)), [[0.0], [1.0]])
        restored = units.restored_tests(tree)
        assert restored.apply(column).tolist() == tree.apply(changed).tolist()
        if len(units.shift.nonzero()[0]):
            exact = Fraction(middle) / Fraction(2) ** int(units.exponent[0]) + Fraction(units.shift[0])
            assert Fraction(-restored.v[0]) <= exact < Fraction(np.nextafter(-restored.v[0], np.inf))


def test_columns_of_ordinary_size_are_left_to_scikit_learn():
    dense = np.random.default_rng(1).uniform(-0.001, 0.001, (3000, 3)) + np.array([0.0, 0.01, 0.5])  # closer than 1e-7
    constant = np.full((3000, 1), 0.3) + np.random.default_rng(1).choice([0.0, 5e-17], (3000, 1))
    rows, targets = np.hstack((dense, constant)), dense @ [1.0, 2.0, 3.0]
    for values in (rows, rows.astype(np.float32), targets[:, None]):
        assert Units.of(values).is_ordinary and Units.of(values).changed(values) is values
    for ours, theirs, y in (
        (CARTClassifier, DecisionTreeClassifier, (targets > targets.mean()).astype(int)),
        (CARTRegressor, DecisionTreeRegressor, targets),
    ):
        expected = from_sklearn_tree(theirs(max_depth=8, random_state=0).fit(rows, y))
        found = ours(max_depth=8, random_state=0).fit(rows, y).tree_
        for name in ("children_left", "P", "v", "c"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_forests_teach_in_any_units():
    labels = np.column_stack((Y, 1 - Y)).astype(float)
    teacher = Teacher(n_estimators=5, weight_of_linear=0.5, C=1e6)
    expected = fit_teacher(X, labels, teacher).predict_proba(FRESH)
    for scale in (2.0**-40, 2.0**-90):
        found = fit_teacher(X * scale, labels, teacher).predict_proba(FRESH * scale)
        assert np.abs(found - expected).mean() < 0.01


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-9, 0.0), (1.0, 1.7e9)])
def test_imitators_read_states_in_any_units(scale, shift):
    states = X * scale + shift
    oracle = otr.ReluNetwork([[[1.0, 1.0]], [[1.0], [-1.0]]], [[-9.0], [0.0, 0.0]], head=otr.Argmax())
    oracle = oracle.fold_input_normalisation(shift, scale)
    outputs = np.eye(2)[Y]
    for fit in (
        CartFit(8),
        AugTreeFit(oracle, 2),
        AugTreeFit(oracle, 2, leaves="linear"),
    ):
        tree = fit(states, outputs, np.ones(len(X)), np.random.default_rng(0))
        assert (tree.predict(states) == Y).mean() > 0.95, fit
    fitted = fit_ndps(
        states, X.sum(axis=1, keepdims=True) * scale, np.ones(len(X)), np.random.default_rng(0),
        head=otr.Identity(), n_outputs=1, depth=1, settings=NdpsSettings(n_updates=300, batch_size=64),
    ).tree  # fmt: skip
    np.testing.assert_allclose(fitted.predict(states) / scale, X.sum(axis=1, keepdims=True), atol=0.5)
