"""Networks for every label and seed, trained together: what they are given and what comes back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import ClassVar, Generic

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils._param_validation import Interval, StrOptions

from otr.core.arrays import FloatArray, IntArray
from otr.core.head import Head
from otr.core.heads import Argmax, Exp, Identity, Sign
from otr.learners.base.parameters import Constraints, Settings
from otr.learners.networks.batched_models import BatchedModels, Loss, Network, SeedStreams, streams_of
from otr.learners.networks.batched_training import Schedule, train_models
from otr.learners.networks.first_layer import InputRows, new_rows

_CHUNK_BYTES = 2**22  # weights of the first layers that are trained together: they should stay in the cache
_HEADS: dict[Loss, Head] = {"logistic": Sign(), "softmax": Argmax(), "squared": Identity(), "poisson": Exp()}


@dataclass(frozen=True, kw_only=True)
class NetworkSettings(Settings, ABC, Generic[Network]):
    """What all kinds of networks have.

    Attributes:
        loss: "logistic" (labels 0 and 1, or probabilities), "softmax" (class numbers), "squared" or "poisson" (counts).
        n_classes: outputs with the softmax loss.
        schedule: see there.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        "loss": [StrOptions(set(_HEADS))],
        "n_classes": [Interval(Integral, 2, None, closed="left")],
        "schedule": [Schedule],
    }

    loss: Loss = "logistic"
    n_classes: int = 2
    schedule: Schedule = field(default_factory=Schedule)

    @property
    def head(self) -> Head:
        """The head of the trained networks."""
        return _HEADS[self.loss]

    def n_models(self, n_labels: int) -> int:
        """Return how many models a seed has: one for each label, unless labels share theirs."""
        return n_labels

    @abstractmethod
    def n_columns(self, n_labels: int) -> int:
        """Return how many neurons of a seed's networks read the inputs."""

    @abstractmethod
    def new_models(self, n_inputs: int, n_labels: int, streams: Sequence[SeedStreams]) -> BatchedModels[Network]:
        """Return the models of all seeds and labels with their first weights."""


@dataclass(frozen=True)
class TrainedNetworks(Generic[Network]):
    """What `train_many` returns."""

    networks: list[list[Network]]  # [label][seed]
    scores: FloatArray  # (L, S), the validation scores of the epochs kept, NaN without validation rows
    epochs: IntArray  # (L, S), those epochs, counted from 1


def train_many(
    X: ArrayLike,
    Y: ArrayLike,
    seeds: Sequence[int],
    settings: NetworkSettings[Network],
    *,
    sample_weight: FloatArray | None = None,
    X_valid: ArrayLike | None = None,
    Y_valid: ArrayLike | None = None,
) -> TrainedNetworks[Network]:
    """Train one network for every label and seed, all at once.

    What comes out is as if each were trained alone, unless labels share hidden layers or an epoch.

    Time grows with n * L * S; binary inputs with few ones cost what their ones cost. See `train_models` for the
    validation score, and `BatchedModels` for what the networks share.

    Args:
        X: (n, d).
        Y: (n, L) or (n,), NaN where a label is missing; with the logistic loss also probabilities of the label 1, as
            `otr.learners.distillation.distillation_set` makes them.
        seeds: S integers >= 0.
        settings: `MlpSettings` or `LcnSettings`: kind, shape and training.
        sample_weight: (n, L) >= 0, as how many rows each one counts in a label's loss; None for one each.
        X_valid, Y_valid: rows that choose each network's best epoch, with labels and no probabilities; without
            them the last is kept.

    Raises:
        ValueError: shapes do not agree, or only one of X_valid, Y_valid is given.
        DivergedError: weights are not finite at the end.
    """
    rows, labels, validation = _checked(X, Y, X_valid, Y_valid)
    n_labels = labels.shape[1]
    n_together = max(1, _CHUNK_BYTES // (4 * rows.n_inputs * settings.n_columns(n_labels)))
    networks: list[list[Network]] = [[] for _ in range(n_labels)]
    scores, epochs = [], []
    for start in range(0, len(seeds), n_together):
        chunk = seeds[start : start + n_together]
        streams = streams_of(chunk, settings.n_models(n_labels))
        models = settings.new_models(rows.n_inputs, n_labels, streams)
        fitted = train_models(models, rows, labels, streams, settings.schedule, validation, sample_weight)
        for label, of_label in enumerate(networks):
            of_label += [models.network(fitted.values, seed, label) for seed in range(len(chunk))]
        scores.append(fitted.scores[: len(chunk)])
        epochs.append(fitted.epochs[: len(chunk)])
    return TrainedNetworks(networks, np.concatenate(scores).T, np.concatenate(epochs).T)


def _checked(
    X: ArrayLike, Y: ArrayLike, X_valid: ArrayLike | None, Y_valid: ArrayLike | None
) -> tuple[InputRows, FloatArray, tuple[InputRows, FloatArray] | None]:
    """Return the training rows with their labels (n, L), and the same of the validation rows."""
    rows, labels = _rows_and_labels(X, Y, "X", "Y")
    if (X_valid is None) != (Y_valid is None):
        raise ValueError("only one of X_valid and Y_valid was given; give both, or none to keep the last epoch")
    if X_valid is None or Y_valid is None:
        return rows, labels, None
    validation = _rows_and_labels(X_valid, Y_valid, "X_valid", "Y_valid")
    if validation[1].shape[1] != labels.shape[1] or validation[0].n_inputs != rows.n_inputs:
        raise ValueError(
            f"X has {rows.n_inputs} inputs and Y {labels.shape[1]} labels, "
            f"X_valid and Y_valid {validation[0].n_inputs} and {validation[1].shape[1]}"
        )
    return rows, labels, validation


def _rows_and_labels(X: ArrayLike, Y: ArrayLike, name_x: str, name_y: str) -> tuple[InputRows, FloatArray]:
    X, Y = np.asarray(X), np.asarray(Y, dtype=np.float64)
    Y = Y[:, None] if Y.ndim == 1 else Y
    if X.ndim != 2 or Y.ndim != 2 or len(X) != len(Y) or not X.size:
        raise ValueError(f"{name_x} has shape {X.shape} and {name_y} {Y.shape}, expected (n, d) and (n, L) with n > 0")
    return new_rows(X), Y
