"""Distillation: what a teacher's rows and probabilities are, and that a network learns more from them."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.ensemble import RandomForestClassifier

from otr.learners import OTRClassifier, OTRRegressor, distillation
from otr.learners.distillation import Teacher, distillation_set
from otr.learners.networks.batched_mlp import MlpSettings
from otr.learners.networks.batched_training import Schedule
from otr.learners.networks.labels_and_seeds import train_many
from otr.learners.networks.validation_scores import areas_under_curve

QUICK = Teacher(n_estimators=10, n_copies=2)


def _votes(n, rng, wrong):
    """60 binary inputs, six for and six against the label, and a share of wrong labels."""
    X = (rng.random((n, 60)) < 0.3).astype(float)
    y = X[:, :6].sum(axis=1) > X[:, 6:12].sum(axis=1)
    return X, (y ^ (rng.random(n) < wrong)).astype(float)


def test_a_student_beats_the_network_trained_on_the_labels():
    gains = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        X, y = _votes(150, rng, wrong=0.25)
        X_test, y_test = _votes(2000, rng, wrong=0.0)
        areas = []
        for rows, targets in ((X, y), distillation_set(X, y, Teacher(n_estimators=50), seed=seed)):
            network = train_many(rows, targets, [seed], MlpSettings()).networks[0][0]
            areas.append(areas_under_curve(network.forward(X_test)[:, 0], y_test))
        gains.append(areas[1] - areas[0])
    assert np.mean(gains) > 0.04
    assert np.sum(np.array(gains) > 0) >= 5


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("forest", ["extra_trees", "random_forest"])
def test_rows_and_probabilities(fingerprints, joint, forest):
    X, Y = fingerprints
    rows, targets = distillation_set(X.astype(np.uint8), Y, replace(QUICK, joint=joint, forest=forest), seed=1)
    assert rows.shape == (900, 120)
    assert rows.dtype == np.uint8
    assert targets.shape == (900, 3)
    np.testing.assert_array_equal(rows[:300], X)
    assert not np.isnan(targets).any()  # of missing labels, too
    assert 0 <= targets.min() < targets.max() <= 1
    assert (areas_under_curve(targets[:300].T, Y.T) > 0.85).all()  # the forest has seen these labels


def test_probabilities_are_the_forests():
    rng = np.random.default_rng(0)
    X, Y = rng.normal(size=(50, 4)), rng.integers(0, 2, (50, 1)).astype(float)
    Y[:10] = np.nan
    teacher = Teacher("random_forest", n_estimators=7, min_samples_leaf=3, n_copies=1)
    rows, targets = distillation_set(X, Y, teacher, seed=2)
    seed = np.random.SeedSequence(2).spawn(5)[3].generate_state(1)[0]
    forest = RandomForestClassifier(7, min_samples_leaf=3, random_state=int(seed)).fit(X[10:], Y[10:, 0])
    np.testing.assert_allclose(targets[:, 0], forest.predict_proba(rows)[:, 1], atol=1e-12)


def test_copies_of_binary_rows_lose_ones_and_gain_none(fingerprints):
    X, Y = fingerprints
    rows, _ = distillation_set(X, Y, replace(QUICK, alteration=0.3))
    for copy in (rows[300:600], rows[600:]):
        assert (copy <= X).all()
        assert copy.sum() / X.sum() == pytest.approx(0.7, abs=0.02)
    assert (rows[300:600] != rows[600:]).any()


def test_copies_of_other_rows_have_entries_of_the_same_input():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 4)) + 10 * np.arange(4)
    rows, _ = distillation_set(X, X[:, 0] > 0, replace(QUICK, alteration=0.4))
    altered = rows[200:400] != X
    assert altered.mean() == pytest.approx(0.4, abs=0.05)
    for column in range(4):
        assert np.isin(rows[:, column], X[:, column]).all()


def test_weight_of_labels_mixes_them_in_where_there_are_any(fingerprints):
    X, Y = fingerprints
    _, soft = distillation_set(X, Y, QUICK)
    _, mixed = distillation_set(X, Y, replace(QUICK, weight_of_labels=0.25))
    labels = np.tile(Y, (3, 1))
    there = ~np.isnan(labels)
    np.testing.assert_allclose(mixed[there], 0.75 * soft[there] + 0.25 * labels[there])
    np.testing.assert_array_equal(mixed[~there], soft[~there])


def test_trees_grown_on_sparse_rows_are_the_same(monkeypatch):
    rng = np.random.default_rng(0)
    X = (rng.random((200, 100)) < 0.02).astype(float)
    Y = X[:, :10].sum(axis=1) > 0
    _, sparse = distillation_set(X, Y, QUICK)
    monkeypatch.setattr(distillation, "_MAX_DENSITY", 0.0)
    _, dense = distillation_set(X, Y, QUICK)
    np.testing.assert_array_equal(sparse, dense)


@pytest.mark.parametrize("joint", [False, True])
def test_a_label_of_one_class_stays_so(fingerprints, joint):
    X, Y = fingerprints
    Y = np.where(np.isnan(Y), Y, np.where(np.arange(3) == 1, 1.0, Y))
    _, targets = distillation_set(X, Y, replace(QUICK, joint=joint))
    np.testing.assert_allclose(targets[:, 1], 1.0, atol=1e-12)


def test_the_seed_decides_everything(fingerprints):
    X, Y = fingerprints
    first, again, parallel, other = (
        distillation_set(X, Y, QUICK, seed=seed, n_jobs=n_jobs) for seed, n_jobs in ((3, 1), (3, 1), (3, 2), (4, 1))
    )
    for same in (again, parallel):
        np.testing.assert_array_equal(first[0], same[0])
        np.testing.assert_array_equal(first[1], same[1])
    assert (first[0][300:] != other[0][300:]).any()
    assert (first[1][:300] != other[1][:300]).any()


def test_classifiers_learn_from_a_teacher(fingerprints):
    X, Y = fingerprints
    model = OTRClassifier((4,), teacher=QUICK, epochs=3, decay_every=10, random_state=5).fit(X, Y)
    settings = MlpSettings(hidden=(4,), schedule=Schedule(epochs=3))
    expected = train_many(*distillation_set(X, Y, QUICK, seed=5), [5], settings)
    for network, of_label in zip(model.networks_, expected.networks, strict=True):
        np.testing.assert_array_equal(network.forward(X), of_label[0].forward(X))


@pytest.mark.parametrize("model", [OTRClassifier(teacher=QUICK), OTRRegressor(teacher=QUICK)])
def test_a_teacher_is_for_binary_labels(model):
    X, y = np.random.default_rng(0).normal(size=(30, 2)), np.arange(30) % 3
    with pytest.raises(ValueError, match=r"teacher .* binary labels"):
        model.fit(X, y)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ([0.0, 1.0, 2.0], "the value 2.0"),
        ([0.0, 0.5, np.nan], "the value 0.5"),
        ([np.nan] * 3, "label 0 is missing in all rows"),
        ([0.0, 1.0], r"X has shape \(3, 2\) and Y \(2, 1\)"),
    ],
)
def test_what_cannot_be_distilled(labels, message):
    with pytest.raises(ValueError, match=message):
        distillation_set(np.zeros((3, 2)), labels, QUICK)
