"""The small networks that a search begins with and moves among, in states that are normalised as they are met."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Argmax, ClipBox
from otr.core.network import ReluNetwork


@dataclass(frozen=True)
class NetworkShape:
    """Networks of one shape as vectors: all weights and biases, layer by layer, each row [W | b].

    They read (x - mean) / scale and answer, in a box of actions, in units of half its width from its middle; both are
    folded into the network that `network` returns, which reads x and acts in the box.

    Attributes:
        n_inputs: components of the state, d.
        hidden_widths: hidden neurons of each layer; none for a linear policy.
        n_outputs: labels, or components of the action.
        box: least and greatest actions, (o,) each; None where actions are labels.
        dense: "input" for a linear map of the state next to the neurons, in every layer after the first.
        negative_slope: of the activation below zero.
    """

    n_inputs: int
    hidden_widths: tuple[int, ...]
    n_outputs: int
    box: tuple[FloatArray, FloatArray] | None
    dense: Literal[False, "input"] = False
    negative_slope: float = 0.0

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Shape of each layer's rows [W | b], the output layer last."""
        links = self.n_inputs if self.dense else 0
        read = [self.n_inputs, *(width + links for width in self.hidden_widths)]
        return [(n, columns + 1) for n, columns in zip((*self.hidden_widths, self.n_outputs), read, strict=True)]

    @property
    def n_numbers(self) -> int:
        """Length of the vector."""
        return sum(rows * columns for rows, columns in self.shapes)

    def initial(self, generator: np.random.Generator) -> FloatArray:
        """Return the vector (n_numbers,) of a network that does nothing yet: its neurons random, its outputs zero."""
        parts = []
        for layer, (rows, columns) in enumerate(self.shapes):
            form = np.zeros((rows, columns))
            if layer < len(self.hidden_widths):
                form[:, :-1] = generator.normal(size=(rows, columns - 1)) / np.sqrt(columns - 1)
            parts.append(form.ravel())
        return np.concatenate(parts)

    def forms(self, vector: FloatArray) -> list[FloatArray]:
        """Return the layers' rows [W | b], views of the vector (n_numbers,)."""
        ends = np.cumsum([rows * columns for rows, columns in self.shapes])
        return [part.reshape(shape) for part, shape in zip(np.split(vector, ends[:-1]), self.shapes, strict=True)]

    def network(self, vector: FloatArray, mean: ArrayLike, scale: ArrayLike) -> ReluNetwork:
        """Return the network of the environment's own states and actions.

        Args:
            vector: (n_numbers,).
            mean, scale: (d,) each, what states are normalised by.
        """
        forms = self.forms(vector)
        head: Head = Argmax()
        if self.box is not None:
            low, high = self.box
            half, head = (high - low) / 2, ClipBox(low, high)
            forms[-1] = forms[-1] * half[:, None]
            forms[-1][:, -1] += low + half
        network = ReluNetwork(
            [form[:, :-1] for form in forms],
            [form[:, -1] for form in forms],
            negative_slope=self.negative_slope,
            dense=self.dense if self.hidden_widths else False,
            head=head,
        )
        return network.fold_input_normalisation(mean, scale)
