"""Stacks of small multilayer perceptrons of one shape: forward and backward as batched products, written by hand.

Every parameter of a stack is a view into one flat vector, so that an optimiser, a copy or a target's update is one
operation. Activations live in a workspace that passes share one after another, which keeps them in the cache.

With `precision="bf16"` the products between wide layers, where almost all arithmetic is, take bfloat16 factors and sum
in float32; parameters, first and last layers and everything elementwise stay float32.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

WIDE = 64  # layers at least this wide on both sides take part in precision="bf16"
FLAT_MULTIPLE = 64  # flat vectors are padded, so that no run's numbers fall into a vector loop's scalar rest


@dataclass(frozen=True)
class Layers:
    """A stack of n networks with layer widths w0, ..., wk, as views into `flat`.

    Attributes:
        flat: (padded,), every weight, then every bias, layer by layer and within a layer network by network.
        weights: (n, w[i], w[i+1]) each: inputs times weights, which the products are faster with than transposed.
        biases: (n, 1, w[i+1]) each.
        factors: the weights as they enter products: the weights themselves, or their bfloat16 copies.
    """

    flat: Tensor
    weights: list[Tensor]
    biases: list[Tensor]
    factors: list[Tensor]

    def only(self, network: int) -> "Layers":
        """Return one network as a stack of its own, in the same memory; it has no flat vector."""
        one = slice(network, network + 1)
        parts = ([tensor[one] for tensor in tensors] for tensors in (self.weights, self.biases, self.factors))
        return Layers(self.flat[:0], *parts)

    def refresh(self) -> None:
        """Bring the bfloat16 copies up to date; to be called after every change of the weights."""
        for factor, weight in zip(self.factors, self.weights, strict=True):
            if factor is not weight:
                factor.copy_(weight)


def new_layers(n: int, widths: Sequence[int], device: torch.device, precision: str = "fp32") -> Layers:
    """Return a stack of n networks, all zeros."""
    shapes = list(itertools.pairwise(widths))
    sizes = [n * w_out * w_in for w_in, w_out in shapes]
    bias_sizes = [n * w_out for w_out in widths[1:]]
    total = sum(sizes) + sum(bias_sizes)
    flat = torch.zeros(math.ceil(total / FLAT_MULTIPLE) * FLAT_MULTIPLE, device=device)
    parts = iter(torch.split(flat[:total], [*sizes, *bias_sizes]))
    weights = [next(parts).view(n, w_in, w_out) for w_in, w_out in shapes]
    biases = [next(parts).view(n, 1, w_out) for _, w_out in shapes]
    factors = [
        torch.zeros_like(weight, dtype=torch.bfloat16) if precision == "bf16" and is_wide(weight) else weight
        for weight in weights
    ]
    return Layers(flat, weights, biases, factors)


def is_wide(weight: Tensor) -> bool:
    """Return whether products with this weight may take bfloat16 factors."""
    return min(weight.shape[1:]) >= WIDE


class StackedMlp:
    """The workspace for n (leaky) ReLU networks of one shape on `n_rows` inputs each.

    Args:
        layers: any stack of the shape that will pass through; only its shapes and types matter.
        n_rows: inputs per network.
        negative_slope: 0 is ReLU.
        n_back_rows: the first so many inputs take part in `backward`; None for all.
    """

    def __init__(
        self, layers: Layers, n_rows: int, negative_slope: float = 0.0, n_back_rows: int | None = None
    ) -> None:
        n, device = len(layers.weights[0]), layers.flat.device
        self.n_rows = n_rows
        self._slope = negative_slope
        self._back_rows = slice(n_rows if n_back_rows is None else n_back_rows)
        widths = [weight.shape[2] for weight in layers.weights]
        # What a layer gives out has the type of what the next one multiplies.
        types = [factor.dtype for factor in layers.factors[1:]] + [torch.float32]
        self._outputs = [
            torch.empty(n, n_rows, width, device=device, dtype=dtype)
            for width, dtype in zip(widths, types, strict=True)
        ]
        self._deltas = [torch.empty_like(output[:, self._back_rows]) for output in self._outputs[:-1]]
        self._scratch = [  # products in bfloat16 whose results are wanted in float32, and the other way round
            torch.empty(n, n_rows, width, device=device, dtype=factor.dtype) if factor.dtype != dtype else None
            for width, factor, dtype in zip(widths, layers.factors, types, strict=True)
        ]
        self._weight_scratch = [
            torch.empty_like(factor) if factor.dtype != torch.float32 else None for factor in layers.factors
        ]

    @property
    def outputs(self) -> Tensor:
        """What the last `forward` returned."""
        return self._outputs[-1]

    def forward(self, layers: Layers, inputs: Tensor) -> Tensor:
        """Return the outputs (n, n_rows, w_last) of inputs (n, n_rows, w0); they are overwritten by the next pass."""
        x = inputs
        last = len(self._outputs) - 1
        for i, (factor, bias, output) in enumerate(zip(layers.factors, layers.biases, self._outputs, strict=True)):
            scratch = self._scratch[i]
            product = output if scratch is None else scratch
            torch.bmm(x, factor, out=product)
            torch.add(product, bias, out=output)
            if i < last:
                self._activate(output)
            x = output
        return x

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
            d_outputs: (n, n_back_rows, w_last), the loss's derivative by the outputs.
            gradients: where the derivatives by weights and biases are written; None where they are not wanted.
            inputs_from: the derivative by the inputs from this column on is returned; None where it is not wanted.

        Returns:
            (n, n_back_rows, w0 - inputs_from), or None.
        """
        delta = d_outputs
        for i in reversed(range(len(layers.weights))):
            x = (self._outputs[i - 1] if i else inputs)[:, self._back_rows]
            factor = layers.factors[i]
            if delta.dtype != factor.dtype:
                delta = delta.to(factor.dtype)
            if gradients is not None:
                scratch = self._weight_scratch[i]
                if scratch is None:
                    torch.bmm(x.transpose(1, 2), delta, out=gradients.weights[i])
                else:
                    torch.bmm(x.transpose(1, 2), delta, out=scratch)
                    gradients.weights[i].copy_(scratch)
                torch.sum(delta, 1, keepdim=True, dtype=torch.float32, out=gradients.biases[i])
            if i == 0:
                return None if inputs_from is None else torch.bmm(delta, factor[:, inputs_from:].transpose(1, 2))
            below = self._deltas[i - 1]
            if below.dtype == factor.dtype:
                torch.bmm(delta, factor.transpose(1, 2), out=below)
            else:
                below.copy_(torch.bmm(delta, factor.transpose(1, 2)))
            self._activate_backward(below, x)
            delta = below
        raise AssertionError("a network has layers")

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
