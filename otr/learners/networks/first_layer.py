"""A first layer's products with rows: sums of weight rows for binary inputs, matrix products otherwise.

Networks that read the same rows at the same time are side by side in one table of weights, (d, C) with C the columns of
all of them, and tables of different groups (seeds) are below each other, (G * d, C). A binary row with k ones out of d
adds k rows of its table, which is d / k times less arithmetic than the product: for a molecule's fingerprint about
forty times. The sums run in the order of the inputs in every column by itself.
"""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from torch import Tensor

from otr.core.arrays import IntArray

IndexArray = NDArray[np.signedinteger]  # scipy takes the smallest integers that do
_MAX_DENSITY = 0.15  # a sum over ones costs about as much as this share of the product


class Batch(Protocol):
    """A mini-batch of B rows in each of G groups."""

    def times(self, table: Tensor) -> Tensor:
        """Return the products of every group's rows with its weights (G * d, C): (G, B, C)."""

    def transposed_times(self, deltas: Tensor) -> Tensor:
        """Return the derivative by the table, (G * d, C), of derivatives (G, B, C) by what `times` returned."""

    def draw_masks(self, draws: list[np.random.Generator], dropout: float, n_masks: int) -> Tensor:
        """Return 0 and 1, the latter with probability 1 - dropout, for every input of every row and of `n_masks`.

        Group g draws from `draws[g]`. The layout is the batch's own; the masks are for the two methods below.
        """

    def masked_times(self, table: Tensor, masks: Tensor) -> Tensor:
        """Return `times` with column c's inputs multiplied with mask c % n_masks."""

    def transposed_masked_times(self, deltas: Tensor, masks: Tensor) -> Tensor:
        """Return the derivative by the table of derivatives by what `masked_times` returned."""


class InputRows(Protocol):
    """All rows of a data set, ready to be cut into mini-batches."""

    n_rows: int
    n_inputs: int

    def times(self, table: Tensor) -> Tensor:
        """Return the product of all rows with one group's weights (d, C): (n, C)."""

    def batch(self, rows: IntArray, dropout: float = 0.0, draws: list[np.random.Generator] | None = None) -> Batch:
        """Return the mini-batch of `rows` (G, B), with every input dropped with probability `dropout`.

        Inputs that stay are not scaled. Group g draws from `draws[g]`; a generator that is given several times in
        a row draws for its groups one after another.
        """


def new_rows(X: NDArray[np.generic]) -> InputRows:
    """Return the rows of X (n, d): sparse where X is binary with few ones, else dense float32."""
    ones = X != 0
    if X.size and ones.mean() <= _MAX_DENSITY and bool((X[ones] == 1).all()):
        return SparseRows(ones)
    return DenseRows(X)


class SparseRows:
    """Binary rows, held as the list of their ones."""

    def __init__(self, ones: NDArray[np.bool_]) -> None:
        """Keep where the ones are, of (n, d)."""
        self.n_rows, self.n_inputs = ones.shape
        self._ones = csr_array(ones)

    def times(self, table: Tensor) -> Tensor:
        """Return the product of all rows with one group's weights."""
        return _sum_rows(table, self._ones.indices, self._ones.indptr)

    def batch(self, rows: IntArray, dropout: float = 0.0, draws: list[np.random.Generator] | None = None) -> Batch:
        """Return a mini-batch, see `InputRows`."""
        n_groups = len(rows)
        chosen = self._ones[rows.ravel()]
        inputs, starts = chosen.indices, chosen.indptr
        if dropout:
            assert draws is not None
            per_group = np.diff(starts[:: rows.shape[1]])
            kept = np.concatenate(
                [draw.random(n, dtype=np.float32) >= dropout for draw, n in zip(draws, per_group, strict=True)]
            )
            inputs, starts = inputs[kept], np.concatenate(([0], np.cumsum(kept)))[starts].astype(starts.dtype)
        return _SparseBatch(inputs, starts, n_groups, self.n_inputs)


class _SparseBatch:
    """The ones of a mini-batch: entries starts[i] .. starts[i + 1] are those of row i of the G * B rows."""

    def __init__(self, inputs: IndexArray, starts: IndexArray, n_groups: int, n_inputs: int) -> None:
        n_bags = len(starts) - 1
        self._shape = (n_groups, n_bags // n_groups, -1)
        self._n_entries = np.diff(starts[:: n_bags // n_groups])
        self._keys = inputs + np.repeat(np.arange(n_groups, dtype=inputs.dtype) * n_inputs, self._n_entries)
        self._starts, self._n_keys = starts, n_groups * n_inputs

    def times(self, table: Tensor) -> Tensor:
        return _sum_rows(table, self._keys, self._starts).view(*self._shape)

    def transposed_times(self, deltas: Tensor) -> Tensor:
        by_key = self._by_key
        return _sum_rows(deltas.reshape(-1, deltas.shape[-1]), by_key.indices, by_key.indptr)

    def draw_masks(self, draws: list[np.random.Generator], dropout: float, n_masks: int) -> Tensor:
        kept = [
            draw.random((n, n_masks), dtype=np.float32) >= dropout
            for draw, n in zip(draws, self._n_entries, strict=True)
        ]
        return torch.from_numpy(np.concatenate(kept).astype(np.float32))

    def masked_times(self, table: Tensor, masks: Tensor) -> Tensor:
        terms = _masked(table[torch.from_numpy(self._keys)], masks)
        return _sum_rows(terms, np.arange(len(terms), dtype=self._starts.dtype), self._starts).view(*self._shape)

    def transposed_masked_times(self, deltas: Tensor, masks: Tensor) -> Tensor:
        flat = deltas.reshape(-1, deltas.shape[-1])
        terms = _masked(flat[torch.from_numpy(self._by_key.indices)], masks[torch.from_numpy(self._by_key.data)])
        return _sum_rows(terms, np.arange(len(terms), dtype=self._starts.dtype), self._by_key.indptr)

    @cached_property
    def _by_key(self) -> csc_array:
        """The numbers of the entries, in a column for each of the table's rows; their indices are the entries' rows."""
        entries = np.arange(len(self._keys), dtype=self._starts.dtype)
        shape = (len(self._starts) - 1, self._n_keys)
        return csr_array((entries, self._keys, self._starts), shape=shape).tocsc()


def _masked(terms: Tensor, masks: Tensor) -> Tensor:
    """Multiply terms (entries, C) in place with masks (entries, n_masks), n_masks columns at a time; return them."""
    terms.view(len(terms), -1, masks.shape[1]).mul_(masks[:, None])
    return terms


def _sum_rows(table: Tensor, rows: IndexArray, starts: IndexArray) -> Tensor:
    """Return, for every i, the sum of table[rows[starts[i]:starts[i + 1]]]."""
    sums: Tensor = torch.embedding_bag(
        table, torch.from_numpy(rows), torch.from_numpy(starts), False, 0, False, None, True
    )[0]
    return sums


class DenseRows:
    """Rows of any numbers, in float32."""

    def __init__(self, X: NDArray[np.generic]) -> None:
        """Keep a float32 copy of X (n, d)."""
        self.n_rows, self.n_inputs = X.shape
        self._X = torch.from_numpy(np.array(X, dtype=np.float32))

    def times(self, table: Tensor) -> Tensor:
        """Return the product of all rows with one group's weights."""
        return self._X @ table

    def batch(self, rows: IntArray, dropout: float = 0.0, draws: list[np.random.Generator] | None = None) -> Batch:
        """Return a mini-batch, see `InputRows`."""
        X = self._X[torch.from_numpy(rows)]
        if dropout:
            assert draws is not None
            kept = np.stack([draw.random(X.shape[1:], dtype=np.float32) >= dropout for draw in draws])
            X = X * torch.from_numpy(kept)
        return _DenseBatch(X)


class _DenseBatch:
    """The rows of a mini-batch, (G, B, d)."""

    def __init__(self, X: Tensor) -> None:
        self._X = X

    def times(self, table: Tensor) -> Tensor:
        return torch.bmm(self._X, table.view(len(self._X), self._X.shape[2], -1))

    def transposed_times(self, deltas: Tensor) -> Tensor:
        return torch.bmm(self._X.transpose(1, 2), deltas).flatten(0, 1)

    def draw_masks(self, draws: list[np.random.Generator], dropout: float, n_masks: int) -> Tensor:
        shape = (n_masks, *self._X.shape[1:])
        kept = [draw.random(shape, dtype=np.float32) >= dropout for draw in draws]
        return torch.from_numpy(np.stack(kept).astype(np.float32))

    def masked_times(self, table: Tensor, masks: Tensor) -> Tensor:
        n_groups, n_masks = masks.shape[:2]
        weights = table.view(n_groups, self._X.shape[2], -1, n_masks)
        parts = [torch.bmm(self._X * masks[:, m], weights[..., m]) for m in range(n_masks)]
        return torch.stack(parts, dim=-1).flatten(2)

    def transposed_masked_times(self, deltas: Tensor, masks: Tensor) -> Tensor:
        n_groups, n_masks = masks.shape[:2]
        split = deltas.view(n_groups, self._X.shape[1], -1, n_masks)
        parts = [torch.bmm((self._X * masks[:, m]).transpose(1, 2), split[..., m]) for m in range(n_masks)]
        return torch.stack(parts, dim=-1).flatten(2).flatten(0, 1)
