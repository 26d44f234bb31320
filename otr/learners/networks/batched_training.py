"""Training of many small models at once by mini-batch SGD: the loop that multilayer perceptrons and LCNs share.

A row whose label is missing has weight zero in that label's loss, and the others of the mini-batch share the weight:
the loss of a step is the mean over the rows with a label, B times the share of labels in expectation. Against dropping
the rows label by label, which would give each label mini-batches of its own, only the number of rows behind a step
differs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from sklearn.base import BaseEstimator
from torch import Tensor
from torch.optim.sgd import sgd

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.errors import DivergedError
from otr.learners.base.parameters import (
    AT_LEAST_1,
    BELOW_1,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    Constraints,
    Settings,
    parameters_of,
)
from otr.learners.networks.batched_models import PADDED_TO, BatchedModels, Loss, SeedStreams
from otr.learners.networks.denormals import denormals_as_zero
from otr.learners.networks.first_layer import InputRows
from otr.learners.networks.validation_scores import areas_under_curve, negative_losses

# Without `epochs`: fewer steps leave small data sets far from fitted (docs/decisions/supervised.md).
_LEAST_STEPS, _LEAST_EPOCHS = 1000, 30


@dataclass(frozen=True)
class Schedule(Settings):
    """How networks are trained; the defaults are those of LCN's code (Lee & Jaakkola 2020), which the thesis took over.

    Attributes:
        epochs: passes over the rows.
        batch_size: rows a step.
        learning_rate: of SGD with Nesterov momentum, in epoch e = 1, 2, ... times ``decay ** (e // decay_every)``.
        momentum: 0 to 1.
        l1, l2: penalties l1 * sum |w| and l2 / 2 * sum w**2 added to the loss; biases are free.
        averaging: decay of an exponential moving average of the weights, by step; 0 for none. The average is what is
            scored and kept.
        label_smoothing: share of the target that is spread over the classes.
        common_epoch: keep one epoch for all labels of a seed, the best by the mean of their validation scores. A few
            hundred validation rows choose an epoch badly; so they choose once, not once a label.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        "epochs": [AT_LEAST_1],
        "batch_size": [AT_LEAST_1],
        "learning_rate": [POSITIVE],
        "momentum": [SHARE],
        "decay": [POSITIVE],
        "decay_every": [AT_LEAST_1],
        "l1": [NOT_NEGATIVE],
        "l2": [NOT_NEGATIVE],
        "averaging": [BELOW_1],
        "label_smoothing": [SHARE],
        "common_epoch": ["boolean"],
    }

    epochs: int = 30
    batch_size: int = 64
    learning_rate: float = 0.1
    momentum: float = 0.9
    decay: float = 0.1
    decay_every: int = 10
    l1: float = 0.0
    l2: float = 0.0
    averaging: float = 0.0
    label_smoothing: float = 0.0
    common_epoch: bool = False

    def rate(self, epoch: int) -> float:
        """Return the learning rate in `epoch`, counted from 1."""
        return self.learning_rate * self.decay ** (epoch // self.decay_every)


def schedule_of(estimator: BaseEstimator, n_rows: int) -> Schedule:
    """Return the schedule of an estimator's parameters, whose `epochs` and `decay_every` may be None.

    Without epochs there are as many as make 1,000 steps, and 30 at least; without `decay_every` it is a third of them.
    """
    settings = parameters_of(estimator, Schedule)
    if settings["epochs"] is None:
        steps_of_an_epoch = math.ceil(n_rows / settings["batch_size"])
        settings["epochs"] = max(_LEAST_EPOCHS, math.ceil(_LEAST_STEPS / steps_of_an_epoch))
    if settings["decay_every"] is None:
        settings["decay_every"] = math.ceil(settings["epochs"] / 3)
    return Schedule(**settings)


@dataclass(frozen=True)
class Fitted:
    """What `train_models` kept."""

    values: list[Tensor]  # of the parameters, every model's at its best epoch
    scores: FloatArray  # (S, L), the validation score there; NaN without validation rows
    epochs: IntArray  # (S, L), the epoch, counted from 1


@torch.no_grad()
@denormals_as_zero()
def train_models(
    models: BatchedModels[Any],
    rows: InputRows,
    Y: FloatArray,
    streams: Sequence[SeedStreams],
    schedule: Schedule,
    validation: tuple[InputRows, FloatArray] | None,
    sample_weight: FloatArray | None = None,
) -> Fitted:
    """Train all S x L models on n rows and keep each at its best epoch by validation score, the first of equals.

    Labels Y (n, L) are NaN where missing. A step's loss is the mean over its rows with a label, each weighted by its
    `sample_weight` (n, L), divided by the mean weight of all rows with that label. Labels whose validation rows are of
    one class do not take part in choosing a common epoch, where others do. The score is the area under the ROC curve
    for the logistic loss, or minus the loss where the validation rows of a label are of one class and for the other
    losses. The last epoch is kept without validation rows, and of a label that is missing in all of them. Raise
    DivergedError if a model's parameters are not finite at its best epoch.
    """
    targets = torch.from_numpy(np.nan_to_num(Y.T).astype(np.float32))
    present = torch.from_numpy((~np.isnan(Y.T)).astype(np.float32))
    counts = present
    if sample_weight is not None:
        counts = present * torch.from_numpy(sample_weight.T)
        counts = (counts * (present.sum(1) / counts.sum(1).clamp_(min=1e-300))[:, None]).float()
    optimiser = _NesterovSgd(models, schedule)
    flats = [parameter.flat for parameter in models.parameters]
    averages = [flat.clone() for flat in flats] if schedule.averaging else flats
    scored = [parameter.view(flat) for parameter, flat in zip(models.parameters, averages, strict=True)]
    voters = None
    is_told: BoolArray = np.ones(Y.shape[1], dtype=np.bool_)
    if validation is not None:
        is_told = np.asarray(~np.isnan(validation[1]).all(axis=0))
        if schedule.common_epoch or models.shares_labels:
            voters = _voters(models.loss, validation[1])
    kept = _Kept(models, len(streams), is_told, voters)
    for epoch in range(1, schedule.epochs + 1):
        models.start_epoch(epoch, schedule.epochs)
        order = np.stack([stream.order.permutation(rows.n_rows) for stream in streams])
        for chosen, *labels in _mini_batches(order, targets, present, counts, schedule.batch_size):
            models.step_gradients(rows, chosen, *labels)
            if schedule.l1:
                for parameter in models.parameters:
                    if parameter.penalised:
                        parameter.flat_gradient.add_(parameter.flat.sign(), alpha=schedule.l1)
            optimiser.step(schedule.rate(epoch))
            if schedule.averaging:
                torch._foreach_lerp_(averages, flats, 1 - schedule.averaging)
        if validation is not None:
            outputs = models.outputs(validation[0], scored).double().numpy()
            kept.offer(epoch, scored, _validation_scores(models.loss, outputs, validation[1]))
        elif epoch == schedule.epochs:
            kept.offer(epoch, scored, np.zeros((len(streams), Y.shape[1])))
    fitted = kept.fitted(validation is not None)
    _check_finite(models, fitted, streams)
    return fitted


def _mini_batches(
    order: IntArray, targets: Tensor, present: Tensor, counts: Tensor, batch_size: int
) -> Iterator[tuple[IntArray, Tensor, Tensor]]:
    """Yield an epoch's mini-batches: chosen rows (S, B), targets and weights (S, L, B); see `step_gradients`.

    The rows come in `order` (S, n); of all rows, the targets are 0 where they are missing, `present` (L, n) is 0 there,
    else 1, and `counts` (L, n) are the weights, of mean 1 where the label is present. A mini-batch gets rows of weight
    zero up to a multiple of `PADDED_TO`.
    """
    picked = torch.from_numpy(order)
    targets, present, counts = (labels[:, picked].transpose(0, 1).contiguous() for labels in (targets, present, counts))
    for start in range(0, order.shape[1], batch_size):
        mine = slice(start, start + batch_size)
        chosen, of_batch, weights = order[:, mine], targets[..., mine], counts[..., mine]
        n_present = present[..., mine].sum(2, keepdim=True).clamp_(min=1.0)
        n_more = -chosen.shape[1] % PADDED_TO
        if n_more:
            chosen = np.concatenate((chosen, np.repeat(chosen[:, :1], n_more, axis=1)), axis=1)
            of_batch, weights = (torch.nn.functional.pad(labels, (0, n_more)) for labels in (of_batch, weights))
        yield chosen, of_batch, weights / n_present


class _NesterovSgd:
    """torch's SGD in its functional form: `torch.optim.SGD` loads the compiler, which takes seconds."""

    def __init__(self, models: BatchedModels[Any], schedule: Schedule) -> None:
        self._parameters, self._momentum, self._l2 = models.parameters, schedule.momentum, schedule.l2
        self._buffers = [torch.zeros_like(p.flat) if schedule.momentum else None for p in models.parameters]

    def step(self, rate: float) -> None:
        for penalised in (True, False):
            mine = [i for i, parameter in enumerate(self._parameters) if parameter.penalised is penalised]
            sgd(
                [self._parameters[i].flat for i in mine],
                [self._parameters[i].flat_gradient for i in mine],
                [self._buffers[i] for i in mine],
                weight_decay=self._l2 if penalised else 0.0,
                momentum=self._momentum,
                lr=rate,
                dampening=0.0,
                nesterov=self._momentum > 0,
                maximize=False,
                has_sparse_grad=False,
                foreach=False,
                fused=True,
            )


class _Kept:
    """Every model's parameters at its best epoch so far."""

    def __init__(self, models: BatchedModels[Any], n_seeds: int, is_told: BoolArray, voters: BoolArray | None) -> None:
        """Choose by the mean score of `voters` (L,), or label by label; `is_told` (L,) is where there is a score."""
        self._parameters, self._is_told, self._voters = models.parameters, is_told, voters
        n_labels = len(is_told)
        self._best = np.full((n_seeds, n_labels), -np.inf)
        self._values = [torch.zeros_like(parameter.values) for parameter in models.parameters]
        self._scores = np.full((n_seeds, n_labels), -np.inf)
        self._epochs = np.zeros((n_seeds, n_labels), dtype=np.int64)

    def offer(self, epoch: int, values: Sequence[Tensor], scores: FloatArray) -> None:
        ranked = np.where(self._is_told, scores, epoch)  # without a score a later epoch is better
        if self._voters is not None:
            ranked = np.broadcast_to(ranked[:, self._voters].mean(axis=1, keepdims=True), scores.shape)
        better = (ranked > self._best) | (self._epochs == 0)
        self._best[better] = ranked[better]
        self._scores[better] = scores[better]
        self._epochs[better] = epoch
        chosen = torch.from_numpy(better)
        for parameter, mine, new in zip(self._parameters, self._values, values, strict=True):
            mine, new = parameter.of_models(mine), parameter.of_models(new)
            mask = chosen[:, : mine.shape[1]]
            mask = mask.view(*mask.shape, *[1] * (mine.ndim - 2))
            mine.copy_(torch.where(mask, new, mine))

    def fitted(self, validated: bool) -> Fitted:
        return Fitted(self._values, self._scores if validated else np.full_like(self._scores, np.nan), self._epochs)


def _validation_scores(loss: Loss, outputs: FloatArray, Y: FloatArray) -> FloatArray:
    """Return the scores (S, L) of outputs (S, L, n, o)."""
    losses = negative_losses(loss, outputs, Y.T)
    if loss != "logistic":
        return losses
    areas = areas_under_curve(outputs[..., 0], Y.T)
    return np.where(np.isnan(areas), losses, areas)


def _voters(loss: Loss, Y: FloatArray) -> BoolArray:
    """Return which labels (L,) have a say in a common epoch: those with both classes, else those with any rows."""
    if loss == "logistic":
        both = (Y == 0).any(axis=0) & (Y == 1).any(axis=0)
        if both.any():
            return np.asarray(both)
    is_told = ~np.isnan(Y).all(axis=0)
    return np.asarray(is_told if is_told.any() else ~is_told)


def _check_finite(models: BatchedModels[Any], fitted: Fitted, streams: Sequence[SeedStreams]) -> None:
    for parameter, values in zip(models.parameters, fitted.values, strict=True):
        finite = parameter.of_models(values).flatten(2).isfinite().all(2)
        if not finite.all():
            # A single model is held twice (see `streams_of`).
            found = dict.fromkeys((streams[i].seed, label) for i, label in torch.nonzero(~finite).tolist())
            n_models = len({stream.seed for stream in streams}) * finite.shape[1]
            seed, label = next(iter(found))
            raise DivergedError(
                f"training diverged: {len(found)} of {n_models} models have weights that are not finite, the first is "
                f"label {label} of seed {seed}; lower learning_rate or scale the inputs"
            )
