"""Networks with other units than ReLU, mostly smooth, such as tanh: they cannot be mapped, but imitated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf, expit

from otr.core.arrays import FloatArray, as_states
from otr.core.black_box import BlackBox
from otr.core.domain import Domain
from otr.core.head import Head
from otr.core.network import ReluNetwork
from otr.errors import InvalidNetworkError

_SELU_SCALE, _SELU_ALPHA = 1.0507009873554804934193349852946, 1.6732632423543772848170429916717  # Klambauer 2017


def _elu(z: FloatArray) -> FloatArray:
    return np.where(z > 0, z, np.expm1(np.minimum(z, 0)))


def _softplus(z: FloatArray) -> FloatArray:
    return np.where(z > 20, z, np.logaddexp(0, z))  # as torch has it


# By the names of torch's modules, with their default arguments.
ACTIVATIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "tanh": np.tanh,
    "sigmoid": expit,
    "silu": lambda z: z * expit(z),
    "elu": _elu,
    "gelu": lambda z: 0.5 * z * (1 + erf(z / np.sqrt(2))),
    "celu": _elu,
    "selu": lambda z: _SELU_SCALE * np.where(z > 0, z, _SELU_ALPHA * np.expm1(np.minimum(z, 0))),
    "softplus": _softplus,
    "softsign": lambda z: z / (1 + np.abs(z)),
    "mish": lambda z: z * np.tanh(_softplus(z)),
    "logsigmoid": lambda z: -np.logaddexp(0, -z),
    "hardtanh": lambda z: np.clip(z, -1, 1),
    "relu6": lambda z: np.clip(z, 0, 6),
    "hardsigmoid": lambda z: np.clip(z + 3, 0, 6) / 6,
    "hardswish": lambda z: z * np.clip(z + 3, 0, 6) / 6,
}


class SmoothNetwork:
    """A network of affine layers with one of ACTIVATIONS between them, as an oracle: y(x), and the head's answer.

    Attributes:
        weights, biases: of the layers, (n_out, n_in) and (n_out,).
        activation: one of ACTIVATIONS.
        head: from the outputs to the answer.
        domain: the box of states on which the network is the policy that it was read from; None for all.
    """

    def __init__(
        self,
        weights: Sequence[ArrayLike],
        biases: Sequence[ArrayLike],
        *,
        activation: str,
        head: Head | None = None,
        domain: Domain | None = None,
    ) -> None:
        """Copy and check the arrays.

        Raises:
            InvalidNetworkError: as `ReluNetwork` does, or the activation is none of ACTIVATIONS.
        """
        if activation not in ACTIVATIONS:
            raise InvalidNetworkError(f"the activation is {activation!r}, expected one of {', '.join(ACTIVATIONS)}")
        layers = ReluNetwork(weights, biases, head=head, domain=domain)
        self._layers = layers
        self.weights, self.biases, self.head, self.domain = layers.weights, layers.biases, layers.head, layers.domain
        self.n_inputs, self.n_outputs, self.n_answers = layers.n_inputs, layers.n_outputs, layers.n_answers
        self.hidden_widths, self.n_hidden = layers.hidden_widths, layers.n_hidden
        self.activation = activation

    def __repr__(self) -> str:
        widths = " -> ".join(map(str, (self.n_inputs, *self.hidden_widths, self.n_outputs)))
        return f"SmoothNetwork({widths}, activation={self.activation!r}, head={self.head!r})"

    @property
    def reason(self) -> str:
        """Why no tree equals it, for messages."""
        return f"the units are {self.activation}"

    def forward(self, X: ArrayLike) -> FloatArray:
        """Return the affine outputs y: (n, o) for states (n, d), (o,) for one state (d,)."""
        a = as_states(X, self.n_inputs)
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            a = ACTIVATIONS[self.activation](a @ W.T + b)
        return np.asarray(a @ self.weights[-1].T + self.biases[-1])

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the head's answers: (n, o) values or (n,) labels; without the first axis for one state."""
        return self.head(self.forward(X))

    def fold_input_normalisation(self, mean: ArrayLike, scale: ArrayLike) -> SmoothNetwork:
        """Return the network that answers on raw x as this one does on (x - mean) / scale; see `ReluNetwork`."""
        folded = self._layers.fold_input_normalisation(mean, scale)
        return SmoothNetwork(
            folded.weights, folded.biases, activation=self.activation, head=self.head, domain=folded.domain
        )

    def replace(self, **changes: Any) -> SmoothNetwork:
        """Return the same network with other layers, or another head or domain."""
        names = ("weights", "biases", "activation", "head", "domain")
        return SmoothNetwork(**{name: getattr(self, name) for name in names} | changes)


Layered = ReluNetwork | SmoothNetwork
Oracle = Layered | BlackBox  # what a tree can imitate
