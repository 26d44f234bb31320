"""Stacks of small multilayer perceptrons of one shape: forward and backward passes written by hand.

Every parameter of a stack is a view into one array with a row a network, so that an optimiser, a copy or a target's
update is one operation. Activations live in a workspace that passes share one after another, which keeps them in the
cache. A network's bits do not depend on how many there are (`stacked_tensors`).

With `dense`, layers after the first read the inputs in addition to the activations before them: concat(a, x), as in
`otr.ReluNetwork` with `dense="input"`.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from otr.control.sac.stacked_tensors import multiply, new_flat, new_stack


@dataclass(frozen=True)
class Layers:
    """A stack of n networks with layer widths w0, ..., wk, as views into `flat`."""

    flat: Tensor  # (n, padded), a network's weights, then its biases, layer by layer, each followed by zeros
    # (n, w[i], w[i+1]) each: inputs times weights, with which products are faster than transposed; where layers are
    # dense, those after the first have w0 rows more
    weights: list[Tensor]
    biases: list[Tensor]  # (n, 1, w[i+1]) each

    def only(self, network: int) -> "Layers":
        """Return one network as a stack of its own, in the same memory."""
        one = slice(network, network + 1)
        parts = ([tensor[one] for tensor in tensors] for tensors in (self.weights, self.biases))
        return Layers(self.flat[one], *parts)

    def named(self, networks: slice) -> dict[str, Tensor]:
        """Return views of the weights and biases of some networks, by name."""
        kinds = (("weight", self.weights), ("bias", self.biases))
        return {f"{kind}{layer}": each[networks] for kind, tensors in kinds for layer, each in enumerate(tensors)}

    def initialise(self, networks: slice, generator: torch.Generator) -> None:
        """Draw networks as torch's Linear does."""
        for weight, bias in zip(self.weights, self.biases, strict=True):
            limit = 1 / math.sqrt(weight.shape[1])
            for view in (weight[networks], bias[networks]):
                view.copy_((2 * torch.rand(view.shape, generator=generator) - 1) * limit)


def new_layers(n: int, widths: Sequence[int], dense: bool = False) -> Layers:
    """Return a stack of n networks, all zeros, of torch's default type (float32 unless a test sets another)."""
    shapes = [(w_in + dense * (i > 0) * widths[0], w_out) for i, (w_in, w_out) in enumerate(itertools.pairwise(widths))]
    flat, tensors = new_flat(n, [*shapes, *((1, w_out) for w_out in widths[1:])])
    return Layers(flat, tensors[: len(shapes)], tensors[len(shapes) :])


class StackedMlp:
    """The workspace for n (leaky) ReLU networks of one shape on `n_rows` inputs each.

    Args:
        layers: any stack of the shape that will pass through; only its shapes matter.
        n_rows: inputs per network.
        negative_slope: 0 is ReLU.
        n_back_rows: how many inputs, the first ones, take part in `backward`; None for all.
        dense: whether layers after the first read the inputs, too.
    """

    def __init__(
        self,
        layers: Layers,
        n_rows: int,
        negative_slope: float = 0.0,
        n_back_rows: int | None = None,
        dense: bool = False,
    ) -> None:
        self.n_rows = n_rows
        self._n_networks = len(layers.flat)
        self._slope = negative_slope
        self._dense = dense
        self._n_back_rows = n_rows if n_back_rows is None else n_back_rows
        self._stacks: dict[tuple[str, int], Tensor] = {}
        self._outputs = [self._stack("output", i, (n_rows, weight.shape[2])) for i, weight in enumerate(layers.weights)]
        # What the layers after the first read, by the layer before them
        self._read = [
            self._stack("read", i, (n_rows, weight.shape[1])) if dense else output
            for i, (weight, output) in enumerate(zip(layers.weights[1:], self._outputs, strict=False))
        ]

    @property
    def outputs(self) -> Tensor:
        """What the last `forward` returned."""
        return self._outputs[-1]

    def forward(self, layers: Layers, inputs: Tensor) -> Tensor:
        """Return the outputs (n, n_rows, w_last) of inputs (n, n_rows, w0), a stack of `new_stack`.

        The next pass overwrites them.
        """
        x = inputs
        last = len(self._outputs) - 1
        for i, (weight, bias, output) in enumerate(zip(layers.weights, layers.biases, self._outputs, strict=True)):
            torch.add(multiply(x, weight, output), bias, out=output)
            if i < last:
                self._activate(output)
                x = self._read[i]
                if self._dense:
                    x[:, :, : output.shape[2]] = output
                    x[:, :, output.shape[2] :] = inputs
        return self.outputs

    def backward(
        self,
        layers: Layers,
        inputs: Tensor,
        d_outputs: Tensor,
        gradients: Layers | None,
        inputs_from: int | None = None,
    ) -> Tensor | None:
        """Go back through the last `forward`.

        Args:
            layers: as in forward.
            inputs: as in forward.
            d_outputs: (n, n_back_rows, w_last), the loss's derivative by the outputs, a stack of `new_stack`.
            gradients: where the derivatives by weights and biases are written; None where they are not wanted.
            inputs_from: the derivative by the inputs from this column on is returned; None where it is not wanted, and
                always for dense networks, of which it would be a part.

        Returns:
            (n, n_back_rows, w0 - inputs_from), or None; the next pass overwrites it.
        """
        delta = d_outputs
        for i in reversed(range(len(layers.weights))):
            x = (self._read[i - 1] if i else inputs)[:, : self._n_back_rows]
            if gradients is not None:
                multiply(x.transpose(1, 2), delta, gradients.weights[i])
                torch.sum(delta, 1, keepdim=True, out=gradients.biases[i])
            if i == 0 and inputs_from is None:
                return None
            output = self._outputs[i - 1][:, : self._n_back_rows]
            weight = layers.weights[i][:, : output.shape[2]] if i else layers.weights[i][:, inputs_from:]
            below = self._stack("delta", i, (self._n_back_rows, weight.shape[1]))
            multiply(delta, weight.transpose(1, 2), below)
            if i == 0:
                return below
            self._activate_backward(below, output)
            delta = below
        raise AssertionError("a network has layers")

    def _stack(self, use: str, layer: int, shape: tuple[int, ...]) -> Tensor:
        """Return the memory of a use in a layer, (n, *shape), made the first time."""
        if (use, layer) not in self._stacks:
            self._stacks[use, layer] = new_stack(self._n_networks, *shape)
        return self._stacks[use, layer]

    def _activate(self, values: Tensor) -> None:
        if self._slope == 0.0:
            values.relu_()
        else:
            torch.nn.functional.leaky_relu_(values, self._slope)

    def _activate_backward(self, delta: Tensor, outputs: Tensor) -> None:
        """Multiply `delta` in place with the activation's derivative, read off its outputs."""
        if self._slope == 0.0:
            torch.ops.aten.threshold_backward.grad_input(delta, outputs, 0.0, grad_input=delta)
        else:
            torch.ops.aten.leaky_relu_backward.grad_input(delta, outputs, self._slope, True, grad_input=delta)
