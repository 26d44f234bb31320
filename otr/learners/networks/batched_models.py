"""Many small models of one shape that train together: their random streams, parameters and losses.

There are S x L of them: S seeds, L labels. All models of a seed see the same mini-batches, so that their first layers
are one product; everything random about a model (first weights, order, dropout) follows from its seed alone. A model is
therefore the same, up to rounding, whatever labels and seeds are trained with it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from otr.core.arrays import IntArray
from otr.learners.networks.first_layer import InputRows

PADDED_TO = 64
Loss = Literal["logistic", "softmax", "squared", "poisson"]
MOST_LOG_COUNT = 5.0  # 148 times the mean, beyond which a gradient does not grow
Network = TypeVar("Network")


@dataclass
class SeedStreams:
    """The random streams of one seed, each its own."""

    seed: int
    weights: np.random.Generator
    order: np.random.Generator
    dropout: np.random.Generator

    @classmethod
    def of(cls, seed: int) -> SeedStreams:
        """Return the streams of `seed`."""
        return cls(seed, *(np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3)))


def streams_of(seeds: Sequence[int], n_labels: int) -> list[SeedStreams]:
    """Return the streams of the seeds; a single model is held twice.

    torch multiplies the matrices of a batch of one by another routine, which rounds differently.
    """
    return [SeedStreams.of(seed) for seed in [*seeds] * (2 if len(seeds) * n_labels == 1 else 1)]


class Parameter:
    """One tensor of all models, with its gradient.

    Both are in flat vectors that are padded: torch's vector loops compute the rest of a vector differently, in the last
    bit, and a model's numbers must not depend on its position.

    Attributes:
        flat, flat_gradient: the padded vectors.
        values: the tensor, a view of `flat`.
        shape: a shape under which the first axis is the seed and axis `label_axis` the label.
        label_axis: see there.
        penalised: whether l1 and l2 apply.
    """

    def __init__(self, values: Tensor, label_axis: int, penalised: bool, shape: Sequence[int] | None = None) -> None:
        """Take over `values`, with the seed as first axis, unless `shape` says how to see them so."""
        self.shape = tuple(values.shape if shape is None else shape)
        self.label_axis, self.penalised = label_axis, penalised
        self._size, self._own_shape = values.numel(), values.shape
        self.flat = torch.zeros(math.ceil(self._size / PADDED_TO) * PADDED_TO)
        self.values = self.view(self.flat)
        self.values.copy_(values)
        self.flat_gradient = torch.zeros_like(self.flat)

    @property
    def gradient(self) -> Tensor:
        """The loss's derivative by it, a view of `flat_gradient`, to be written to."""
        return self.view(self.flat_gradient)

    def set_gradient(self, gradient: Tensor) -> None:
        """Take over a gradient; without a copy where nothing is to be padded."""
        if self._size == len(self.flat) and gradient.is_contiguous():
            self.flat_gradient = gradient.view(-1)
        else:
            self.gradient.copy_(gradient.reshape(self._own_shape))

    def view(self, flat: Tensor) -> Tensor:
        """Return a vector like `flat` as the tensor."""
        return flat[: self._size].view(self._own_shape)

    def of_models(self, values: Tensor) -> Tensor:
        """Return values of the tensor's shape as (S, L, ...)."""
        return values.view(self.shape).movedim(self.label_axis, 1)


class BatchedModels(ABC, Generic[Network]):
    """S x L models of one shape, with gradients written by hand.

    Attributes:
        loss: of all models.
        parameters: all there are; their label axis has one entry if labels share their parameters.
        shares_labels: whether labels share their parameters; then one epoch is kept for all labels of a seed.
    """

    loss: Loss
    parameters: list[Parameter]
    shares_labels: bool = False

    def start_epoch(self, epoch: int, n_epochs: int) -> None:
        """Prepare for `epoch` of 1 .. n_epochs."""

    @abstractmethod
    def step_gradients(self, rows: InputRows, chosen: IntArray, targets: Tensor, weights: Tensor) -> None:
        """Give the parameters the loss's derivatives.

        `chosen` (S, B) are the rows of the mini-batch of each seed, B a multiple of `PADDED_TO`; targets and weights
        (S, L, B) are those of `loss_derivatives`.
        """

    @abstractmethod
    def outputs(self, rows: InputRows, values: Sequence[Tensor]) -> Tensor:
        """Return the outputs (S, L, n, o) of all rows, as after training, for these values of the parameters."""

    @abstractmethod
    def network(self, values: Sequence[Tensor], seed: int, label: int) -> Network:
        """Return one model as a network, for these values of the parameters."""


def loss_derivatives(loss: Loss, outputs: Tensor, targets: Tensor, weights: Tensor, smoothing: float = 0.0) -> Tensor:
    """Return the derivatives of sum_i weights_i loss_i by the outputs (..., o).

    The logistic loss has one output and targets in [0, 1], softmax o classes and their numbers as targets, squared is
    (y - target)**2, and poisson exp(y) - target * y, whose y is cut off at `MOST_LOG_COUNT`. Targets and weights are
    (...); a weight is 0 where the target is missing. `smoothing` is the share of a target that is spread evenly over
    the classes.
    """
    if loss == "squared":
        return (outputs - targets[..., None]) * (2 * weights[..., None])
    if loss == "poisson":
        return (outputs.clamp(max=MOST_LOG_COUNT).exp() - targets[..., None]) * weights[..., None]
    if loss == "logistic":
        goal = targets[..., None]
        if smoothing:
            goal = goal * (1 - smoothing) + smoothing / 2
        return (outputs.sigmoid() - goal) * weights[..., None]
    n_classes = outputs.shape[-1]
    derivatives = outputs.softmax(-1) - smoothing / n_classes
    index = targets.long()[..., None]
    derivatives.scatter_add_(-1, index, torch.full(index.shape, smoothing - 1.0))
    return derivatives * weights[..., None]
