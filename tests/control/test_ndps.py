import dataclasses

import numpy as np
import pytest
import torch

import otr
from otr.control.ndps import NdpsFit, NdpsSettings, fit_ndps
from otr.core.mapping import perfect_tree_children

torch.set_num_threads(1)

SETTINGS = NdpsSettings(n_updates=1_000, batch_size=256)
FEW = dataclasses.replace(SETTINGS, n_updates=30)  # where it does not matter how good the tree is


def planted(seed: int, n: int = 3_000) -> tuple[np.ndarray, otr.ObliqueTree]:
    """States of very different units, and a tree of depth 2 on them."""
    rng = np.random.default_rng(seed)
    spread, centre = np.array([0.01, 1.0, 300.0]), np.array([5.0, 0.0, -100.0])
    X = centre + spread * rng.normal(size=(n, 3))
    P, M = rng.normal(size=(3, 3)) / spread, rng.normal(size=(4, 2, 3)) / spread
    v, c = rng.normal(size=3) * 0.3 - P @ centre, rng.normal(size=(4, 2)) - M @ centre
    return X, otr.ObliqueTree(*perfect_tree_children(2), P, v, M, c)


def fit(X, answers, head, *, start=None, seed=0, depth=2, settings=SETTINGS, weights=None) -> NdpsFit:
    return fit_ndps(
        X, answers, np.ones(len(X)) if weights is None else weights, np.random.default_rng(seed), head=head,
        n_outputs=2, depth=depth, settings=settings, start=start.module if start else None,
    )  # fmt: skip


def test_a_planted_tree_is_recovered_from_actions_and_labels_whose_weights_count():
    X, tree = planted(0)
    actions = tree.forward(X)
    fitted = fit(X, actions, otr.Identity()).tree
    assert (fitted.depth, fitted.n_leaves) == (2, 4)
    assert np.square(fitted.predict(X) - actions).mean() < 0.02 * actions.var()
    X, tree = planted(2)
    labels = tree.forward(X).argmax(axis=1)
    first = fit(X, labels, otr.Argmax())
    again = fit(X, labels, otr.Argmax(), start=first, seed=1)
    assert first.tree.labels is not None and (first.tree.predict(X) == labels).mean() > 0.95
    assert (again.tree.predict(X) == labels).mean() > 0.97
    np.testing.assert_array_equal(first.module.harden(otr.Argmax()).predict(X), first.tree.predict(X))
    X = np.tile(np.random.default_rng(0).normal(size=(500, 3)), (2, 1))
    labels, weights = np.repeat([0, 1], 500), np.repeat([1.0, 3.0], 500)  # every state has both answers
    short = dataclasses.replace(SETTINGS, n_updates=300)
    assert fit(X, labels, otr.Argmax(), weights=weights, settings=short).tree.predict(X).mean() > 0.95
    assert not fit(X, 0 * labels, otr.Argmax(), settings=short).tree.predict(X).any()  # a label that no row has


def test_actions_at_the_edge_may_be_overshot():
    X = np.random.default_rng(0).normal(size=(1_000, 3))
    head = otr.ClipBox([-0.5, -0.5], [0.5, 0.5])
    actions = head(X @ np.array([[2.0, -1.0], [1.0, 3.0], [0.0, 1.0]]))  # one clipped affine map
    assert (np.abs(actions) == 0.5).mean() > 0.7
    fitted = fit(X, actions, head).tree
    assert np.square(fitted.predict(X) - actions).mean() / actions.var() < 0.015
    assert np.abs(fitted.forward(X)).max() > 2.0


@pytest.mark.parametrize("leaves", ["linear", "constant"])
@pytest.mark.parametrize(("spread", "has_box"), [(0.0, True), (1e-3, False), (1e-3, True), (1.0, False)])
def test_a_component_that_varies_little_beside_its_mean_is_learnt(spread, has_box, leaves):
    """In its own units its error is about that of a component without a mean, or far below where it is constant."""
    X = np.random.default_rng(0).normal(size=(2_000, 3))
    wave, unit = np.clip(X[:, 0], -1.0, 1.0), spread or 1.0
    actions = np.stack([wave, 100.0 + spread * wave], axis=1)
    head = otr.ClipBox([-1.0, 100.0 - unit], [1.0, 100.0 + unit]) if has_box else otr.Identity()
    settings, fitted = NdpsSettings(n_updates=300, leaves=leaves), None
    for _ in range(2):
        fitted = fit(X, actions, head, depth=4, settings=settings, start=fitted)
        error, error_beside_mean = np.sqrt(np.square(fitted.tree.predict(X) - actions).mean(axis=0)) / [1.0, unit]
        assert error < (0.1 if leaves == "linear" else 0.3)
        assert error_beside_mean < (1.5 * error if spread else 0.01)


@pytest.mark.parametrize("gives_labels", [True, False])
def test_constant_leaves_are_recovered_and_rounds_go_on(gives_labels):
    X, planted_tree = planted(7)  # of others a fit may stay at a worse optimum
    tree = planted_tree.replace(M=np.zeros_like(planted_tree.M), c=np.eye(4)[:, :2] + [[0, 0], [0, 0], [2, 0], [0, 2]])
    outputs = tree.forward(X)
    answers = outputs.argmax(axis=1) if gives_labels else outputs
    head = otr.Argmax() if gives_labels else otr.Identity()
    settings = dataclasses.replace(SETTINGS, leaves="constant")
    first = fit(X, answers, head, settings=settings)
    again = fit(X, answers, head, settings=settings, start=first, seed=1)
    for fitted in (first.tree, again.tree):
        assert (fitted.depth, fitted.n_leaves) == (2, 4) and not fitted.M.any()
        assert np.isclose(fitted.predict(X), answers, atol=0.1).mean() > 0.97


def test_the_same_generator_gives_the_same_tree_whatever_the_precision_of_the_states():
    X, tree = planted(3, 300)
    single = X.astype(np.float32)
    fits = [(single, 0), (single.astype(np.float64), 0), (single, 1)]
    one, two, other = (fit(x, tree.forward(X), otr.Identity(), seed=s, settings=FEW).tree for x, s in fits)
    np.testing.assert_array_equal(one.P, two.P)
    np.testing.assert_array_equal(one.M, two.M)
    assert not np.array_equal(one.P, other.P)
    with pytest.raises(ValueError, match="3 states, 2 answers"):
        fit(np.zeros((3, 1)), np.zeros((2, 2)), otr.Identity())
