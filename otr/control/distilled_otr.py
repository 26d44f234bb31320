"""A dense OTR as the student of an oracle: a small network fitted to a large one's answers, whose tree is exact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp

from otr.control.dagger.row_sampling import draw_rows
from otr.control.search.small_networks import NetworkShape
from otr.control.search.state_moments import scale_of
from otr.control.settings import StudentSettings
from otr.core.arrays import BoolArray, FloatArray
from otr.core.head import Head
from otr.core.pattern_tree import PatternTree
from otr.setting import Checked

_SHARE_OF_A_START = 0.25  # of the updates: the share of every start before the best one continues


@dataclass(frozen=True)
class StudentFit(StudentSettings, Checked):
    """The fit of a DAgger run whose imitators are small networks, with a linear map of the state next to the neurons.

    The student f minimises, over n rows drawn alike from the data,

        1/n sum_i  loss(f(x_i), oracle(x_i))  +  ridge |theta|^2 / 2

    with the cross-entropy of the oracle's label, or half the squared difference of the actions in units of half their
    box. There, an answer at the box's edge asks for the edge or anything beyond, as the head clips it. States are
    standardised for the fit, constants only centred, and the resulting network reads them unscaled. L-BFGS continues
    from the best of a few starts; a start's neurons turn at states of the data and add nothing to the answer yet.

    Attributes:
        head: `Argmax` for labels, else the box of the actions (`ClipBox`).
        hidden_widths: hidden neurons of each layer.
    """

    head: Head
    hidden_widths: tuple[int, ...]

    def __call__(
        self, X: FloatArray, answers: FloatArray, weights: FloatArray | None, generator: np.random.Generator
    ) -> PatternTree:
        """Return the tree of the network fitted to states X (n, d) and what `run_dagger` says of them.

        Raises:
            ValueError: the actions have no finite box.
        """
        rows, _ = draw_rows(len(X), None, self.max_samples, generator)
        states = np.asarray(X[rows])
        mean = states.mean(axis=0)
        scale = scale_of(mean, states.std(axis=0))
        box = None if self.head.gives_labels else self.head.limits(answers.shape[1])
        if not self.head.gives_labels and (box is None or not np.isfinite(box).all()):
            raise ValueError(f"the head is {self.head!r}, expected Argmax or a ClipBox with finite limits")
        dense: Literal["input", False] = "input" if self.dense == "input" else False
        shape = NetworkShape(X.shape[1], self.hidden_widths, answers.shape[1], box, dense, self.negative_slope)
        loss = _Loss.of(shape, (states - mean) / scale, answers[rows], self.ridge)
        few = max(1, round(self.n_updates * _SHARE_OF_A_START))
        starts = [
            loss.minimised(loss.initial(generator), few) for _ in range(self.n_starts if self.hidden_widths else 1)
        ]
        best, _ = min(starts, key=lambda start: start[1])
        vector, _ = loss.minimised(best, self.n_updates)
        return PatternTree(shape.network(vector, mean, scale))


@dataclass(frozen=True)
class _Loss:
    """The loss of a network's numbers over rows, and its gradient by back-propagation."""

    shape: NetworkShape
    X: FloatArray  # (n, d), standardised
    wanted: FloatArray  # (n, o): the oracle's labels as rows of 0 and 1, or its actions in units of half their box
    ridge: float

    @classmethod
    def of(cls, shape: NetworkShape, X: FloatArray, answers: FloatArray, ridge: float) -> _Loss:
        if shape.box is None:
            wanted = np.eye(answers.shape[1])[answers.argmax(axis=1)]
        else:
            low, high = shape.box
            wanted = np.clip((2 * answers - low - high) / (high - low), -1.0, 1.0)
        return cls(shape, X, wanted, ridge)

    def initial(self, generator: np.random.Generator) -> FloatArray:
        """Return a random network whose answer is zero; the first layer's neurons turn at a state of the data each."""
        vector = self.shape.initial(generator)
        if self.shape.hidden_widths:
            rows, columns = self.shape.shapes[0]
            first = vector[: rows * columns].reshape(rows, columns)
            first[:, -1] = -(first[:, :-1] * self.X[generator.integers(len(self.X), size=rows)]).sum(axis=1)
        return vector

    def minimised(self, vector: FloatArray, n_updates: int) -> tuple[FloatArray, float]:
        """Return the numbers after L-BFGS, and their loss."""
        options = {"maxiter": n_updates, "maxcor": 20}
        found = minimize(self.value_and_gradient, vector, jac=True, method="L-BFGS-B", options=options)
        return np.asarray(found.x), float(found.fun)

    def value_and_gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Return the loss and its gradient (n_numbers,)."""
        forms = self.shape.forms(vector)
        slope, read, signs = self.shape.negative_slope, [self.X], list[BoolArray]()
        for form in forms[:-1]:
            z = read[-1] @ form[:, :-1].T + form[:, -1]
            signs.append(z > 0)
            np.maximum(z, slope * z, out=z)
            read.append(np.concatenate((z, self.X), axis=1) if self.shape.dense else z)
        outputs = read[-1] @ forms[-1][:, :-1].T + forms[-1][:, -1]
        value, errors = self._of_outputs(outputs)
        parts: list[FloatArray] = []
        for layer in reversed(range(len(forms))):
            parts.append(np.column_stack((errors.T @ read[layer], errors.sum(axis=0))).ravel())
            if layer:
                width = self.shape.hidden_widths[layer - 1]
                errors = (errors @ forms[layer][:, :width]) * np.where(signs[layer - 1], 1.0, slope)
        gradient = np.concatenate(parts[::-1]) + self.ridge * vector
        return value + 0.5 * self.ridge * float(vector @ vector), gradient

    def _of_outputs(self, outputs: FloatArray) -> tuple[float, FloatArray]:
        """Return the mean loss of outputs (n, o) and its derivative by them."""
        n = len(outputs)
        if self.shape.box is None:
            log_shares = outputs - logsumexp(outputs, axis=1, keepdims=True)
            return -float((self.wanted * log_shares).sum()) / n, (np.exp(log_shares) - self.wanted) / n
        errors = outputs - self.wanted
        errors[((self.wanted >= 1) & (errors > 0)) | ((self.wanted <= -1) & (errors < 0))] = 0.0
        return 0.5 * float((errors**2).sum()) / n, errors / n
