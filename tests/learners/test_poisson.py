"""Counts: the Poisson loss of `OTRRegressor`, and the tree whose answers are expected counts."""

import numpy as np
import pytest
import torch
from sklearn.linear_model import PoissonRegressor
from sklearn.metrics import mean_poisson_deviance
from sklearn.model_selection import train_test_split

import otr
from otr.learners import OTRRegressor
from otr.learners.networks.batched_models import loss_derivatives
from otr.learners.networks.validation_scores import negative_losses


def counts(n: int = 2000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (n, 3) and counts whose logarithmic rate has a kink in the first input."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, 3))
    return X, rng.poisson(5 * np.exp(0.8 * np.abs(X[:, 0]) + 0.3 * X[:, 1])).astype(float)


def test_without_neurons_it_is_poisson_regression() -> None:
    X, y = counts()
    ours = OTRRegressor((), loss="poisson", epochs=60, batch_size=256, random_state=0).fit(X, y)
    theirs = PoissonRegressor(alpha=0.0, tol=1e-8, max_iter=1000).fit(X, y)
    np.testing.assert_allclose(ours.predict(X), theirs.predict(X), rtol=0.03)
    assert mean_poisson_deviance(y, ours.predict(X)) < mean_poisson_deviance(y, theirs.predict(X)) + 0.01


def test_neurons_find_the_kink_and_the_tree_answers_expected_counts() -> None:
    X, X_test, y, y_test = train_test_split(*counts(), random_state=0)
    linear = OTRRegressor((), loss="poisson", random_state=0).fit(X, y)
    model = OTRRegressor((4,), loss="poisson", random_state=0).fit(X, y)
    deviances = [mean_poisson_deviance(y_test, each.predict(X_test)) for each in (linear, model)]
    assert deviances[1] < 0.6 * deviances[0]
    assert isinstance(model.tree_.head, otr.Exp)
    np.testing.assert_allclose(model.predict(X_test), model.network_.predict(X_test)[:, 0], rtol=1e-9)
    (pruned,) = model.prune(X)
    assert "return exp(" in otr.to_text(pruned)


def test_several_counts_seeds_and_weights() -> None:
    X, y = counts(600)
    Y = np.column_stack((y, 100 * y))
    two = OTRRegressor((2,), loss="poisson", random_state=0).fit(X, Y)
    np.testing.assert_allclose(two.predict(X)[:, 1], 100 * two.predict(X)[:, 0], rtol=1e-4)  # the mean is taken out
    first, _ = OTRRegressor((2,), loss="poisson").fit_seeds(X, Y, [0, 1])
    np.testing.assert_allclose(first.predict(X), two.predict(X), rtol=1e-4)
    kept = np.arange(600) < 300
    weighted = OTRRegressor((2,), loss="poisson", random_state=0, standardize=False).fit(X, y, kept.astype(float))
    alone = OTRRegressor((2,), loss="poisson", random_state=0, standardize=False).fit(X[kept], y[kept])
    np.testing.assert_allclose(weighted.predict(X), alone.predict(X), rtol=1e-4)


def test_counts_that_are_words_are_refused_as_elsewhere() -> None:
    X, _ = counts(10)
    with pytest.raises(ValueError, match="could not convert string to float"):
        OTRRegressor(loss="poisson").fit(X, np.array(["one"] * 10))


def test_the_gradient_is_that_of_the_loss() -> None:
    rng = np.random.default_rng(0)
    outputs, targets = torch.tensor(rng.normal(size=(2, 1, 5, 1))), torch.tensor(rng.poisson(2, (2, 1, 5)) * 1.0)
    weights = torch.tensor(rng.random((2, 1, 5)))
    outputs.requires_grad_()
    (weights * (outputs[..., 0].exp() - targets * outputs[..., 0])).sum().backward()
    assert outputs.grad is not None
    torch.testing.assert_close(loss_derivatives("poisson", outputs.detach(), targets, weights), outputs.grad)
    values = -(outputs[..., 0].exp() - targets * outputs[..., 0]).mean(-1)
    np.testing.assert_allclose(
        negative_losses("poisson", outputs.detach().numpy(), targets.numpy()), values.detach().numpy()
    )


@pytest.mark.parametrize(
    ("y", "told"),
    [
        (np.array([1.0, -2.0, 0.0]), "y holds -2, and loss='poisson' is for counts"),
        (np.zeros(3), "y is 0 in every row"),
    ],
)
def test_what_is_no_count_is_refused(y: np.ndarray, told: str) -> None:
    X = np.arange(3.0)[:, None]
    with pytest.raises(ValueError, match=told):
        OTRRegressor(loss="poisson").fit(X, y)
    with pytest.raises(ValueError, match="y of validation holds -1"):
        OTRRegressor(loss="poisson").fit(X, np.ones(3), validation=(X, [1.0, 2.0, -1.0]))
    with pytest.raises(ValueError, match="loss"):
        OTRRegressor(loss="gamma").fit(X, np.ones(3))  # type: ignore[arg-type]


def test_large_counts_where_a_rare_input_is_set_are_learnt_at_a_small_rate() -> None:
    rng = np.random.default_rng(0)
    X = np.column_stack((rng.normal(size=(2000, 3)), rng.random((2000, 5)) < 0.02))
    y = rng.poisson(3 * np.exp(0.5 * X[:, 0]) * np.where(X[:, 3:].any(axis=1), 12, 1)).astype(float)
    for seed in range(3):
        model = OTRRegressor((), loss="poisson", learning_rate=0.01, random_state=seed).fit(X, y)
        assert mean_poisson_deviance(y, model.predict(X)) < 3.0
