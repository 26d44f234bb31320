"""Sums of weight rows against matrix products."""

import numpy as np
import pytest
import torch

from otr.learners.networks.first_layer import DenseRows, SparseRows, new_rows

G, B, D = 2, 8, 40


def _rows(kind: str) -> tuple[np.ndarray, object]:
    rng = np.random.default_rng(0)
    X = (rng.random((20, D)) < 0.1).astype(float) if kind == "sparse" else rng.normal(size=(20, D))
    return X, new_rows(X)


def _chosen() -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.stack([rng.permutation(20)[:B] for _ in range(G)])


def _draws() -> list[np.random.Generator]:
    return [np.random.default_rng(g) for g in range(G)]


def test_kind_follows_the_inputs():
    assert isinstance(_rows("sparse")[1], SparseRows)
    assert isinstance(_rows("dense")[1], DenseRows)
    assert isinstance(new_rows(np.eye(20) * 2), DenseRows)  # few numbers, but no ones
    assert isinstance(new_rows(np.ones((4, 4))), DenseRows)


@pytest.mark.parametrize("kind", ["sparse", "dense"])
def test_products_and_their_derivatives(kind):
    X, rows = _rows(kind)
    table = torch.randn(G * D, 6, generator=torch.Generator().manual_seed(0), requires_grad=True)
    X_batch = torch.tensor(X[_chosen()], dtype=torch.float32)
    expected = torch.bmm(X_batch, table.view(G, D, 6))
    deltas = torch.randn(expected.shape, generator=torch.Generator().manual_seed(1))
    (gradient,) = torch.autograd.grad(expected, table, deltas)
    with torch.no_grad():
        batch = rows.batch(_chosen())
        torch.testing.assert_close(batch.times(table), expected.detach())
        torch.testing.assert_close(batch.transposed_times(deltas), gradient)
        torch.testing.assert_close(rows.times(table[:D]), torch.tensor(X, dtype=torch.float32) @ table[:D])


@pytest.mark.parametrize("kind", ["sparse", "dense"])
def test_dropped_inputs_are_zero_and_the_others_as_they_were(kind):
    X, rows = _rows(kind)
    identity = torch.eye(D).repeat(G, 1)
    dropped = rows.batch(_chosen(), 0.5, _draws()).times(identity).numpy()
    ones = X[_chosen()].astype(np.float32)
    assert set(np.unique(dropped[ones != 0] / ones[ones != 0]).round(6)) == {0.0, 1.0}
    assert 0.4 < (dropped != 0).sum() / (ones != 0).sum() < 0.6


@pytest.mark.parametrize("kind", ["sparse", "dense"])
def test_masks_are_for_every_column_of_their_own(kind):
    X, rows = _rows(kind)
    n_labels, n_masks = 3, 4
    batch = rows.batch(_chosen())
    masks = batch.draw_masks(_draws(), 0.5, n_masks)
    ones = X[_chosen()]
    if kind == "sparse":  # entry by entry, in the order of rows, then inputs
        full = np.zeros((G, B, D, n_masks))
        full[np.nonzero(ones)] = masks.numpy()
    else:
        full = masks.permute(0, 2, 3, 1).numpy()
    table = torch.randn(G * D, n_labels * n_masks, requires_grad=True)
    parts = (torch.tensor(ones), torch.tensor(full), table.double().view(G, D, n_labels, n_masks))
    expected = torch.einsum("gbj,gbjm,gjlm->gblm", *parts).flatten(2).float()
    deltas = torch.randn(expected.shape)
    (gradient,) = torch.autograd.grad(expected, table, deltas)
    with torch.no_grad():
        torch.testing.assert_close(batch.masked_times(table, masks), expected.detach())
        torch.testing.assert_close(batch.transposed_masked_times(deltas, masks), gradient)


def test_many_groups_need_two_sorts():
    X = (np.random.default_rng(0).random((10, 7000)) < 0.01).astype(float)
    rows = new_rows(X)
    chosen = np.stack([np.arange(5) + g % 5 for g in range(10)])  # 70,000 rows of the table
    table, deltas = torch.randn(70_000, 3), torch.randn(10, 5, 3)
    batch = rows.batch(chosen)
    X_batch = torch.tensor(X[chosen], dtype=torch.float32)
    torch.testing.assert_close(batch.times(table), torch.bmm(X_batch, table.view(10, 7000, 3)))
    expected = torch.bmm(X_batch.transpose(1, 2), deltas).flatten(0, 1)
    torch.testing.assert_close(batch.transposed_times(deltas), expected)


def test_rows_without_ones():
    rows = new_rows(np.zeros((3, 5)))
    batch = rows.batch(np.arange(3)[None], 0.5, _draws()[:1])
    assert not batch.times(torch.ones(5, 2)).any()
    assert not batch.transposed_times(torch.ones(1, 3, 2)).any()
