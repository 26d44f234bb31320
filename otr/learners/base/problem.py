"""A learning problem as the learners of networks and linear models see it: encoded labels, scaled inputs."""

from __future__ import annotations

from typing import Literal

import numpy as np

from otr.core.arrays import FloatArray
from otr.learners.base.weights import mean_and_deviation, mean_and_divisor


class Problem:
    """A learning problem whose data has been checked."""

    def __init__(
        self,
        X: FloatArray,
        Y: FloatArray,
        loss: Literal["logistic", "softmax", "squared", "poisson"],
        weights: FloatArray | None = None,
    ) -> None:
        self.X, self.loss = X, loss  # (n, d), shifted and scaled by `mean` and `scale`
        self.Y = Y  # (n, L), NaN where missing: 0 and 1 (logistic), class numbers (softmax), standardised (squared),
        # shares of the mean count (poisson)
        self.weights = weights  # (n,), as how many rows each one counts; None for one each
        # (n, L), the same in the loss of each label, times the weights of its classes
        self.label_weights = None if weights is None else np.tile(weights[:, None], Y.shape[1])
        self.n_classes = 2  # of the softmax loss
        self.X_valid: FloatArray | None = None  # the same for the rows that choose the epoch
        self.Y_valid: FloatArray | None = None
        self.mean, self.scale = np.zeros(X.shape[1]), np.ones(X.shape[1])  # (d,)
        # (L,): y_mean + y_scale * output are the outputs for the targets as they were given; 0 for a constant target
        self.y_mean, self.y_scale = np.zeros(Y.shape[1]), np.ones(Y.shape[1])

    def standardise_inputs(self) -> None:
        """Shift and scale X to mean 0 and standard deviation 1 on the training rows, as they are weighted."""
        self.mean, self.scale = mean_and_divisor(self.X, self.weights)
        self.X = (self.X - self.mean) / self.scale
        if self.X_valid is not None:
            self.X_valid = (self.X_valid - self.mean) / self.scale

    def standardise_targets(self) -> None:
        """Do the same to Y; counts are divided by their mean, whose logarithm the outputs then lack."""
        if self.loss == "poisson":
            means = np.average(self.Y, axis=0, weights=self.weights)
            self.y_mean, self.Y = np.log(means), self.Y / means
            if self.Y_valid is not None:
                self.Y_valid = self.Y_valid / means
            return
        self.y_mean, self.y_scale = mean_and_deviation(self.Y, self.weights)
        divisor = np.where(self.y_scale > 0, self.y_scale, 1.0)
        self.Y = (self.Y - self.y_mean) / divisor
        if self.Y_valid is not None:
            self.Y_valid = (self.Y_valid - self.y_mean) / divisor
