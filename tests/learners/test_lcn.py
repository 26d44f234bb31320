"""LCN: what is trained, what it computes by its definition, and the tree."""

import itertools

import numpy as np
import pytest
import torch

import otr
from otr.learners.networks.batched_lcn import BatchedLcns, LcnSettings
from otr.learners.networks.batched_models import SeedStreams
from otr.learners.networks.batched_training import Schedule
from otr.learners.networks.first_layer import new_rows
from otr.learners.networks.labels_and_seeds import train_many
from otr.learners.networks.lcn_network import LcnNetwork


def _random_network(seed: int, *, hidden: int = 0, n_outputs: int = 1, head: otr.Head | None = None) -> LcnNetwork:
    rng = np.random.default_rng(seed)
    M, d, q = 5, 7, hidden or n_outputs
    second = (rng.normal(size=(n_outputs, hidden)), rng.normal(size=n_outputs)) if hidden else (None, None)
    return LcnNetwork(
        rng.normal(size=(M, d)),
        np.tril(rng.normal(size=(M, M)), -1),
        rng.normal(size=M),
        rng.normal(size=(q, M, d)),
        rng.normal(size=(q, M)),
        rng.normal(size=q),
        *second,
        head or otr.Identity(),
    )


def _by_definition(x, W, U, b, G, h, offset, V, v, *, alpha=1.0, weight_masks=None, link_masks=None):
    """One row's outputs in torch, with the whole Jacobian and autograd's own derivatives of it."""
    activations, J = [], []
    for i in range(len(W)):
        seen = x if weight_masks is None else x * weight_masks[:, i]
        z, row = W[i] @ seen + b[i], W[i]
        for j in range(i):
            link = U[i, j] if link_masks is None else U[i, j] * link_masks[i, j]
            z, row = z + link * activations[j], row + U[i, j] * J[j]
        slope = alpha * (z > 0) + (1 - alpha) * torch.sigmoid(z)
        activations.append(alpha * torch.relu(z) + (1 - alpha) * torch.nn.functional.softplus(z))
        J.append(slope * row)
    Jacobian = torch.stack(J)
    c = torch.stack(activations) - Jacobian @ x
    first = torch.einsum("md,qmd->q", Jacobian, G) + h @ c + offset
    return first if V is None else V @ torch.relu(first) + v


def _arrays(network: LcnNetwork) -> tuple:
    arrays = (network.W, network.U, network.b, network.G, network.h, network.offset, network.V, network.v)
    return tuple(None if array is None else torch.tensor(array) for array in arrays)


@pytest.mark.parametrize(("hidden", "n_outputs"), [(0, 1), (0, 3), (6, 2)])
def test_network_and_tree_compute_the_definition(hidden, n_outputs):
    network = _random_network(0, hidden=hidden, n_outputs=n_outputs)
    X = np.random.default_rng(1).normal(size=(200, 7))
    expected = np.stack([_by_definition(torch.tensor(x), *_arrays(network)).numpy() for x in X])
    np.testing.assert_allclose(network.forward(X), expected, rtol=1e-10, atol=1e-10)
    tree = network.to_tree()
    np.testing.assert_allclose(tree.forward(X), expected, rtol=1e-10, atol=1e-10)
    assert (tree.depth, tree.n_leaves) == (5, 32)
    assert not tree.M.any()


def test_labels_are_the_heads():
    X = np.random.default_rng(1).normal(size=(200, 7))
    for n_outputs, head in ((1, otr.Sign()), (3, otr.Argmax())):
        network = _random_network(2, n_outputs=n_outputs, head=head)
        tree = network.to_tree()
        np.testing.assert_array_equal(tree.predict(X), head(network.forward(X)))
        assert len(np.unique(tree.predict(X))) > 1


def test_scaling_of_inputs_and_outputs():
    rng = np.random.default_rng(1)
    X, mean, scale = rng.normal(size=(50, 7)), rng.normal(size=7), rng.uniform(0.5, 2, size=7)
    for hidden in (0, 6):
        network = _random_network(0, hidden=hidden)
        scaled = network.with_input_scaling(mean, scale).with_output_scaling(3.0, 2.0)
        np.testing.assert_allclose(scaled.forward(X), 3 + 2 * network.forward((X - mean) / scale), atol=1e-9)


def test_shapes_are_checked():
    network = _random_network(0)
    with pytest.raises(otr.InvalidNetworkError, match=r"h has shape \(2, 5\), expected \(1, 5\)"):
        LcnNetwork(network.W, network.U, network.b, network.G, np.zeros((2, 5)), network.offset)
    with pytest.raises(otr.InvalidNetworkError, match="zero on and above the diagonal"):
        LcnNetwork(network.W, network.U + np.eye(5), network.b, network.G, network.h, network.offset)


@pytest.mark.parametrize(("loss", "hidden"), [("logistic", 0), ("softmax", 0), ("squared", 5), ("logistic", 5)])
@pytest.mark.parametrize("drop_connect", [0.0, 0.75])
@pytest.mark.parametrize("alpha", [0.4, 1.0])
def test_gradients_equal_autograds_through_the_jacobian(loss, hidden, drop_connect, alpha):
    rng = np.random.default_rng(0)
    S, L, M, d, B, p = 2, 2, 4, 30, 6, drop_connect
    X = (rng.random((12, d)) < 0.1).astype(float)
    settings = LcnSettings(depth=M, hidden=hidden, loss=loss, n_classes=3, drop_connect=p)
    models = BatchedLcns(d, L, settings, [SeedStreams.of(seed) for seed in range(S)])
    for parameter in models.parameters:
        parameter.values.mul_(3)
    models._alpha = alpha
    chosen = np.stack([rng.permutation(12)[:B] for _ in range(S)])
    targets = torch.tensor(rng.integers(0, 2, size=(S, L, B)), dtype=torch.float32)
    weights = torch.rand(S, L, B, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        models.step_gradients(new_rows(X), chosen, targets, weights)

    draws = [SeedStreams.of(seed).dropout for seed in range(S)]
    weight_masks, link_masks = torch.zeros(S, B, d, M, dtype=torch.float64), None
    if p:
        for seed, row in itertools.product(range(S), range(B)):
            ones = np.flatnonzero(X[chosen[seed, row]])
            kept = draws[seed].random((len(ones), M), dtype=np.float32) >= p
            weight_masks[seed, row, ones] = torch.tensor(kept / (1 - p))
        kept = np.stack([draw.random((B, M, M), dtype=np.float32) for draw in draws]) >= p
        link_masks = torch.tensor(kept / (1 - p))
    values = [parameter.values.double().requires_grad_() for parameter in models.parameters]
    named = dict(zip(models._names, values, strict=True))
    total = torch.zeros((), dtype=torch.float64)
    for seed, label, row in itertools.product(range(S), range(L), range(B)):
        one = [named[name][seed, label] if name in named else None for name in ("U", "b", "G", "h", "offset", "V", "v")]
        y = _by_definition(
            torch.tensor(X[chosen[seed, row]]),
            named["table"].view(S, d, L, M)[seed, :, label].T,
            *one,
            alpha=alpha,
            weight_masks=weight_masks[seed, row] if p else None,
            link_masks=None if link_masks is None else link_masks[seed, row],
        )
        t = targets[seed, label, row]
        cost = (y[0] - t) ** 2 if loss == "squared" else torch.nn.functional.cross_entropy(y, t.long())
        total = total + weights[seed, label, row] * cost
    for parameter, expected in zip(models.parameters, torch.autograd.grad(total, values), strict=True):
        torch.testing.assert_close(parameter.gradient.double(), expected, rtol=1e-4, atol=1e-6)


def test_plain_torch_training_ends_in_the_same_network(fingerprints):
    """Two epochs by torch's autograd and SGD, from the same first weights and mini-batches."""
    X, Y = fingerprints
    X, y = X[:128], np.nan_to_num(Y[:128, 0])
    M, schedule = 3, Schedule(epochs=2, decay_every=2)
    network = train_many(X, y, [5], LcnSettings(depth=M, schedule=schedule)).networks[0][0]
    streams = SeedStreams.of(5)
    models = BatchedLcns(120, 1, LcnSettings(depth=M), [streams])
    named = dict(zip(models._names, (parameter.values.double() for parameter in models.parameters), strict=True))
    W = named["table"].view(120, M).T.contiguous()
    values = [W, *(named[name][0, 0].clone() for name in ("U", "b", "G", "h", "offset"))]
    for value in values:
        value.requires_grad_()
    optimiser = torch.optim.SGD(values, lr=0.1, momentum=0.9, nesterov=True)
    for epoch in (1, 2):
        for group in optimiser.param_groups:
            group["lr"] = 0.1 if epoch < 2 else 0.01
        for rows in torch.tensor(streams.order.permutation(128)).split(64):
            outputs = [_by_definition(torch.tensor(X[r]), *values, None, None, alpha=epoch / 2) for r in rows]
            loss = torch.nn.functional.cross_entropy(torch.stack(outputs), torch.tensor(y[rows]).long())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    for mine, value in zip((network.W, network.U, network.b), values, strict=False):
        np.testing.assert_allclose(mine, value.detach().numpy(), atol=1e-5)
    for mine, two in zip((network.G, network.h, network.offset), values[3:], strict=True):
        np.testing.assert_allclose(mine, np.diff(two.detach().numpy(), axis=0), atol=1e-5)


def test_a_network_does_not_depend_on_its_company(fingerprints):
    X, Y = fingerprints
    settings = LcnSettings(depth=4, drop_connect=0.5, schedule=Schedule(epochs=4))
    together = train_many(X, Y, [3, 1], settings, X_valid=X[:100], Y_valid=Y[:100])
    alone = train_many(X, Y[:, 2], [1], settings, X_valid=X[:100], Y_valid=Y[:100, 2])
    one, other = together.networks[2][1], alone.networks[0][0]
    for name in ("W", "U", "b", "G", "h", "offset"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-4, err_msg=name)
    assert together.scores[2, 1] == pytest.approx(alone.scores[0, 0], abs=1e-3)


@pytest.mark.parametrize("loss", ["logistic", "softmax", "squared"])
@pytest.mark.parametrize("hidden", [0, 6])
def test_trained_networks_equal_their_trees_and_their_scores(fingerprints, loss, hidden):
    X, Y = fingerprints
    settings = LcnSettings(depth=5, hidden=hidden, loss=loss, schedule=Schedule(epochs=3, learning_rate=0.01))
    result = train_many(X, Y, [0, 1], settings, X_valid=X, Y_valid=Y)
    for label, seed in itertools.product(range(3), range(2)):
        network = result.networks[label][seed]
        np.testing.assert_allclose(network.to_tree().forward(X), network.forward(X), rtol=0, atol=1e-10)
        if loss == "squared":
            there = ~np.isnan(Y[:, label])
            error = np.mean((network.forward(X)[there, 0] - Y[there, label]) ** 2)
            assert result.scores[label, seed] == pytest.approx(-error, rel=1e-4)
