"""Policies that a runtime evaluates, whatever their units: they cannot be mapped, but imitated."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.core.arrays import FloatArray, as_states
from otr.core.domain import Domain
from otr.core.head import Head
from otr.core.heads import Identity
from otr.errors import InvalidNetworkError


@dataclass(frozen=True, eq=False)
class BlackBox:
    """A model that a runtime answers, as an oracle: y(x), and the head's answer.

    Attributes:
        run: from states (n, n_inputs), as the model reads them, to outputs (n, n_outputs), float64 each.
        n_inputs, n_outputs: how many numbers these are.
        first_layer: rows [weights | offset] (k, n_inputs + 1) of what the model's first units read.
        reason: why no tree equals it, for messages.
        content, suffix, output: from which it can be read again: the file's bytes, its suffix, the output's name.
        head: from the outputs to the answer.
        middle, scale, clip: the model reads the state x as clip((x - middle) / scale, -clip, clip).
    """

    run: Callable[[FloatArray], FloatArray]
    n_inputs: int
    n_outputs: int
    first_layer: FloatArray
    reason: str
    content: bytes
    suffix: str
    output: str | None = None
    head: Head = field(default_factory=Identity)
    middle: FloatArray = field(default_factory=lambda: np.zeros(1))
    scale: FloatArray = field(default_factory=lambda: np.ones(1))
    clip: float = float("inf")

    domain: Domain | None = None  # it is the policy in every state

    def __post_init__(self) -> None:
        """Raise InvalidNetworkError where the head does not fit the outputs."""
        self.head.check(self.n_outputs)

    def __repr__(self) -> str:
        return f"BlackBox({self.n_inputs} -> {self.n_outputs}, {self.suffix}, head={self.head!r})"

    @property
    def hidden_widths(self) -> tuple[int, ...]:
        """Width of the first layer, the one that is known."""
        return (len(self.first_layer),)

    @property
    def digest(self) -> str:
        """Hexadecimal sha256 of all that decides the answers."""
        parts = [self.middle.tolist(), self.scale.tolist(), self.clip, self.output, self.head.to_dict()]
        return hashlib.sha256(self.content + repr(parts).encode()).hexdigest()

    def forward(self, X: ArrayLike) -> FloatArray:
        """Return the outputs y: (n, o) for states (n, d), (o,) for one state (d,)."""
        states = as_states(X, self.n_inputs)
        Z = np.clip((np.atleast_2d(states) - self.middle) / self.scale, -self.clip, self.clip)
        outputs = np.asarray(self.run(Z), dtype=np.float64).reshape(len(Z), self.n_outputs)
        if not np.isfinite(outputs).all():
            row = int(np.argmin(np.isfinite(outputs).all(axis=1)))
            raise InvalidNetworkError(f"the model answers {outputs[row]} in the state {Z[row].tolist()[:20]}")
        return outputs if states.ndim == 2 else outputs[0]

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the head's answers: (n, o) values or (n,) labels; without the first axis for one state."""
        return self.head(self.forward(X))

    def replace(self, **changes: Any) -> BlackBox:
        """Return the same policy with another head."""
        return replace(self, **changes)

    def fold_input_normalisation(self, mean: ArrayLike, scale: ArrayLike, clip: float = float("inf")) -> BlackBox:
        """Return the policy that answers on raw x as this one does on (x - mean) / scale, within +-clip."""
        mean, scale = np.asarray(mean, dtype=np.float64), np.asarray(scale, dtype=np.float64)
        weights = self.first_layer[:, :-1] / scale
        rows = np.column_stack((weights, self.first_layer[:, -1] - weights @ mean))
        return replace(self, first_layer=rows, middle=mean, scale=scale, clip=clip)
