"""Batched training: gradients, independence of company, missing labels, and what dropout leaves alone."""

import numpy as np
import pytest
import torch

from otr.errors import DivergedError
from otr.learners.networks.batched_mlp import BatchedMlps, MlpSettings
from otr.learners.networks.batched_models import SeedStreams
from otr.learners.networks.batched_training import Schedule
from otr.learners.networks.first_layer import new_rows
from otr.learners.networks.labels_and_seeds import train_many
from otr.learners.networks.validation_scores import areas_under_curve

QUICK = Schedule(epochs=4)


def _equal(one, other) -> bool:
    pairs = zip((*one.weights, *one.biases), (*other.weights, *other.biases), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("dense", [False, "input", "all"])
@pytest.mark.parametrize(
    ("loss", "hidden"), [("logistic", (5, 4, 3)), ("softmax", (5,)), ("squared", (4, 4)), ("logistic", ())]
)
@pytest.mark.parametrize("sparse", [True, False])
def test_gradients_equal_autograds(dense, loss, hidden, sparse):
    rng = np.random.default_rng(0)
    X = (rng.random((20, 30)) < 0.1).astype(float) if sparse else rng.normal(size=(20, 30))
    n_labels, n_rows = 3, 8
    settings = MlpSettings(hidden=hidden, dense=dense, loss=loss, n_classes=3, negative_slope=0.1)
    streams = [SeedStreams.of(seed) for seed in range(2)]
    models = BatchedMlps(30, n_labels, settings, streams)
    chosen = np.stack([rng.permutation(20)[:n_rows] for _ in streams])
    targets = torch.tensor(rng.integers(0, 2, size=(2, n_labels, n_rows)), dtype=torch.float32)
    weights = torch.rand(2, n_labels, n_rows)
    weights[0, 1, :3] = 0.0
    values = [parameter.values for parameter in models.parameters]
    with torch.no_grad():
        models.step_gradients(new_rows(X), chosen, targets, weights)
    gradients = [parameter.gradient.clone() for parameter in models.parameters]
    values = [value.clone().requires_grad_() for value in values]
    total = torch.zeros(())
    for seed in range(2):
        tables = values[0].view(2, 30, -1)
        x = torch.tensor(X[chosen[seed]], dtype=torch.float32)
        y = models._forward(values, torch.stack([x @ table for table in tables]), None)[-1][seed]
        t = targets[seed]
        if loss == "softmax":
            losses = torch.nn.functional.cross_entropy(y.flatten(0, 1), t.long().flatten(), reduction="none").view(
                t.shape
            )
        elif loss == "logistic":
            losses = torch.nn.functional.binary_cross_entropy_with_logits(y[..., 0], t, reduction="none")
        else:
            losses = (y[..., 0] - t) ** 2
        total = total + (losses * weights[seed]).sum()
    for expected, gradient in zip(torch.autograd.grad(total, values), gradients, strict=True):
        torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("input_dropout", "hidden_dropout"), [(0.5, 0.0), (0.0, 0.5), (0.25, 0.25)])
def test_gradients_equal_autograds_with_dropout(fingerprints, input_dropout, hidden_dropout):
    """Against the models's own forward pass, which is checked without dropout above."""
    X, _ = fingerprints
    settings = MlpSettings(dense="input", input_dropout=input_dropout, hidden_dropout=hidden_dropout)
    models, other = (BatchedMlps(120, 2, settings, [SeedStreams.of(seed) for seed in (0, 1)]) for _ in range(2))
    chosen = np.stack([np.arange(64), np.arange(100, 164)])
    targets, weights = torch.ones(2, 2, 64), torch.full((2, 2, 64), 1 / 64)
    with torch.no_grad():
        models.step_gradients(new_rows(X), chosen, targets, weights)
    values = [parameter.values.clone().requires_grad_() for parameter in other.parameters]
    batch = new_rows(X).batch(chosen, input_dropout, [stream.dropout for stream in other._streams])
    products = batch.times(values[0]) / (1 - input_dropout)
    y = other._forward(values, products, other._hidden_masks(64))[-1][..., 0]
    total = (weights * torch.nn.functional.binary_cross_entropy_with_logits(y, targets, reduction="none")).sum()
    for parameter, expected in zip(models.parameters, torch.autograd.grad(total, values), strict=True):
        torch.testing.assert_close(parameter.gradient, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("dense", [False, "input", "all"])
def test_network_computes_what_the_stack_does(fingerprints, dense):
    X, _ = fingerprints
    streams = [SeedStreams.of(seed) for seed in range(2)]
    models = BatchedMlps(X.shape[1], 3, MlpSettings(dense=dense, negative_slope=0.01), streams)
    values = [parameter.values for parameter in models.parameters]
    outputs = models.outputs(new_rows(X), values).double().numpy()
    for seed in range(2):
        for label in range(3):
            network = models.network(values, seed, label)
            np.testing.assert_allclose(network.forward(X), outputs[seed, label], atol=1e-6)


def test_plain_torch_training_ends_in_the_same_network(fingerprints):
    """One network by torch's own layers, loss and SGD, from the same first weights and mini-batches."""
    X, Y = fingerprints
    y = np.nan_to_num(Y[:, 0])
    schedule = Schedule(epochs=3, decay_every=2, l2=1e-3)
    network = train_many(X, y, [7], MlpSettings(schedule=schedule)).networks[0][0]
    streams = SeedStreams.of(7)
    models = BatchedMlps(X.shape[1], 1, MlpSettings(), [streams])
    start = models.network([parameter.values for parameter in models.parameters], 0, 0)
    module = torch.nn.Sequential(
        torch.nn.Linear(120, 8), torch.nn.ReLU(), torch.nn.Linear(8, 8), torch.nn.ReLU(), torch.nn.Linear(8, 1)
    ).double()
    linears = [module[0], module[2], module[4]]
    for linear, W, b in zip(linears, start.weights, start.biases, strict=True):
        linear.weight.data, linear.bias.data = torch.tensor(W), torch.tensor(b)
    groups = [
        {"params": [linear.weight for linear in linears], "weight_decay": 1e-3},
        {"params": [linear.bias for linear in linears]},
    ]
    optimiser = torch.optim.SGD(groups, lr=0.1, momentum=0.9, nesterov=True)
    for epoch in (1, 2, 3):
        for group in optimiser.param_groups:
            group["lr"] = 0.1 if epoch < 2 else 0.01
        for rows in torch.tensor(streams.order.permutation(300)).split(64):
            loss = torch.nn.functional.binary_cross_entropy_with_logits(
                module(torch.tensor(X)[rows])[:, 0], torch.tensor(y)[rows]
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        np.testing.assert_allclose(network.forward(X), module(torch.tensor(X)).numpy(), atol=2e-5)


@pytest.mark.parametrize(
    "settings",
    [
        MlpSettings(schedule=QUICK),
        MlpSettings(
            hidden=(16,), dense="all", input_dropout=0.5, hidden_dropout=0.3, schedule=Schedule(epochs=4, averaging=0.9)
        ),
    ],
)
def test_a_network_does_not_depend_on_its_company(fingerprints, settings):
    X, Y = fingerprints
    valid = {"X_valid": X[:100], "Y_valid": Y[:100]}
    together = train_many(X, Y, [3, 1, 4, 1], settings, **valid)
    # Up to rounding: torch's products sum in an order that depends on where a matrix lies.
    networks = [together.networks[2][position].forward(X) for position in (1, 3, 0)]
    alone = train_many(X, Y[:, 2], [1], settings, X_valid=X[:100], Y_valid=Y[:100, 2])
    for network in networks[:2]:
        np.testing.assert_allclose(network, alone.networks[0][0].forward(X), atol=1e-4)
    assert alone.scores[0, 0] == pytest.approx(together.scores[2, 1], abs=1e-3)
    assert np.abs(networks[2] - networks[0]).max() > 0.01  # another seed


def test_a_row_without_its_label_contributes_nothing(fingerprints):
    """Whatever else the row holds: with other inputs in it, the label's network is the same."""
    X, Y = fingerprints
    missing = np.isnan(Y[:, 0])
    other = X.copy()
    other[missing] = 1 - other[missing]
    settings = MlpSettings(schedule=QUICK)
    one, two = (train_many(rows, Y[:, 0], [0], settings).networks[0][0] for rows in (X, other))
    # The other rows make the inputs dense, so that the arithmetic rounds otherwise.
    np.testing.assert_allclose(one.forward(X), two.forward(X), atol=1e-4)


def test_soft_labels_and_label_smoothing_agree(fingerprints):
    X, Y = fingerprints
    smoothed = train_many(X, Y, [0], MlpSettings(schedule=Schedule(epochs=2, label_smoothing=0.2)))
    soft = train_many(X, Y * 0.8 + 0.1, [0], MlpSettings(schedule=Schedule(epochs=2)))
    for label in range(3):
        np.testing.assert_allclose(
            smoothed.networks[label][0].forward(X), soft.networks[label][0].forward(X), atol=1e-5
        )


@pytest.mark.parametrize("dense", [False, "all"])
def test_shared_layers_are_a_network_with_an_output_for_each_label(fingerprints, dense):
    """Against torch's autograd, with missing labels, and network by network."""
    X, Y = fingerprints
    settings = MlpSettings(hidden=(5, 4), dense=dense, shared=True)
    models = BatchedMlps(120, 3, settings, [SeedStreams.of(0), SeedStreams.of(1)])
    rows, chosen = new_rows(X), np.stack([np.arange(64), np.arange(100, 164)])
    targets = torch.tensor(np.nan_to_num(Y[chosen]), dtype=torch.float32).transpose(1, 2)
    weights = torch.tensor(~np.isnan(Y[chosen]), dtype=torch.float32).transpose(1, 2) / 60
    values = [parameter.values.clone().requires_grad_() for parameter in models.parameters]
    with torch.no_grad():
        models.step_gradients(rows, chosen, targets, weights)
    y = models._forward(values, rows.batch(chosen).times(values[0]), None)[-1][:, 0].transpose(1, 2)
    total = (weights * torch.nn.functional.binary_cross_entropy_with_logits(y, targets, reduction="none")).sum()
    for parameter, expected in zip(models.parameters, torch.autograd.grad(total, values), strict=True):
        torch.testing.assert_close(parameter.gradient, expected, rtol=1e-4, atol=1e-6)

    schedule = Schedule(epochs=3, learning_rate=0.03)
    settings = MlpSettings(hidden=(5, 4), dense=dense, shared=True, schedule=schedule)
    result = train_many(X, Y, [0, 1], settings, X_valid=X[200:], Y_valid=Y[200:])
    for seed in range(2):
        networks = [of_label[seed] for of_label in result.networks]
        assert len({int(epoch) for epoch in result.epochs[:, seed]}) == 1
        for network in networks[1:]:
            for one, other in zip(networks[0].weights[:2], network.weights[:2], strict=True):
                np.testing.assert_array_equal(one, other)
        scores = np.stack([network.forward(X[200:])[:, 0] for network in networks])
        np.testing.assert_allclose(areas_under_curve(scores, Y[200:].T), result.scores[:, seed], atol=1e-3)
    with pytest.raises(ValueError, match="shared is True and loss 'softmax'"):
        MlpSettings(shared=True, loss="softmax")


def test_a_common_epoch_is_the_best_on_average(fingerprints):
    X, Y = fingerprints
    Y_valid = Y[200:].copy()
    Y_valid[:, 2] = 1.0  # of one class: has no say

    def trained(epochs: int, common: bool):
        settings = MlpSettings(schedule=Schedule(epochs=epochs, common_epoch=common))
        return train_many(X[:200], Y[:200], [0], settings, X_valid=X[200:], Y_valid=Y_valid)

    chosen = trained(6, True)
    means = []
    for epoch in range(1, 7):
        last = train_many(X[:200], Y[:200], [0], MlpSettings(schedule=Schedule(epochs=epoch))).networks
        scores = np.stack([of_label[0].forward(X[200:])[:, 0] for of_label in last])
        means.append(areas_under_curve(scores, Y_valid.T)[:2].mean())
    assert set(chosen.epochs.ravel()) == {int(np.argmax(means)) + 1}
    assert len(set(trained(6, False).epochs.ravel())) > 1


def test_l1_makes_weights_small(fingerprints):
    X, Y = fingerprints

    def share(l1: float) -> float:
        schedule = Schedule(epochs=40, l1=l1, decay_every=15)
        network = train_many(X, Y[:, 0], [0], MlpSettings(hidden=(8,), schedule=schedule)).networks[0][0]
        return float((np.abs(network.weights[0]) < 1e-3).mean())

    assert share(0.0) < 0.05
    assert share(3e-3) > 0.5


def test_the_best_epoch_is_kept(fingerprints):
    X, Y = fingerprints
    schedule = Schedule(epochs=6)
    result = train_many(X, Y, [0, 1], MlpSettings(schedule=schedule), X_valid=X[200:], Y_valid=Y[200:])
    for label in range(3):
        for seed in range(2):
            epoch = int(result.epochs[label, seed])
            last = train_many(X, Y, [seed], MlpSettings(schedule=Schedule(epochs=epoch))).networks[label][0]
            assert _equal(last, result.networks[label][seed])


@pytest.mark.parametrize("common_epoch", [False, True])
def test_the_last_epoch_is_kept_of_a_label_without_validation_rows(fingerprints, common_epoch):
    X, Y = fingerprints
    valid = Y[200:].copy()
    valid[:, 1] = np.nan
    settings = MlpSettings(schedule=Schedule(epochs=6, common_epoch=common_epoch))
    result = train_many(X, Y, [0, 1], settings, X_valid=X[200:], Y_valid=valid)
    assert np.isnan(result.scores[1]).all() and not np.isnan(result.scores[[0, 2]]).any()
    expected = result.epochs[0] if common_epoch else 6
    assert (result.epochs[1] == expected).all()
    valid[:] = np.nan
    assert (train_many(X, Y, [0], settings, X_valid=X[200:], Y_valid=valid).epochs == 6).all()


def test_divergence_is_told():
    X = np.random.default_rng(0).normal(size=(100, 4)) * 1e3
    settings = MlpSettings(loss="squared", schedule=Schedule(epochs=5, learning_rate=10.0))
    with pytest.raises(DivergedError, match=r"2 of 2 models.*label 0 of seed 7; lower learning_rate"):
        train_many(X, X[:, :2], [7], settings)
    with pytest.raises(DivergedError, match=r"1 of 1 models"):
        train_many(X, X[:, :1], [7], settings)


def test_shapes_are_checked(fingerprints):
    X, Y = fingerprints
    with pytest.raises(ValueError, match=r"X has shape \(300, 120\) and Y \(299, 3\)"):
        train_many(X, Y[1:], [0], MlpSettings())
    with pytest.raises(ValueError, match="only one of X_valid and Y_valid"):
        train_many(X, Y, [0], MlpSettings(), X_valid=X)
    with pytest.raises(ValueError, match="Y 3 labels, X_valid and Y_valid 120 and 2"):
        train_many(X, Y, [0], MlpSettings(), X_valid=X, Y_valid=Y[:, :2])
