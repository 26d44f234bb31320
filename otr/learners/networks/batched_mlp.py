"""Many small (leaky) ReLU multilayer perceptrons trained as one batched model, labels x seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import torch
from sklearn.utils._param_validation import StrOptions
from torch import Tensor

from otr.core.arrays import IntArray
from otr.core.network import ReluNetwork
from otr.learners.base.parameters import BELOW_1, Constraints, Widths
from otr.learners.networks.batched_models import BatchedModels, Parameter, SeedStreams, loss_derivatives
from otr.learners.networks.first_layer import InputRows
from otr.learners.networks.labels_and_seeds import NetworkSettings


@dataclass(frozen=True, kw_only=True)
class MlpSettings(NetworkSettings[ReluNetwork]):
    """Shape and training of the networks.

    Attributes:
        hidden: widths of the hidden layers; none is a linear model.
        dense: as in `ReluNetwork`.
        negative_slope: of the activation below zero.
        shared: the labels of a seed share their hidden layers in training, which minimises the sum of their losses;
            each label's network is the shared layers with its own output. Not with the softmax loss.
        input_dropout, hidden_dropout: share of inputs, and of hidden neurons, that a training row loses; the rest is
            scaled up, and after training nothing is dropped.
        loss, n_classes, schedule: see `NetworkSettings`.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        **NetworkSettings._parameter_constraints,
        "hidden": [Widths()],
        "dense": ["boolean", StrOptions({"input", "all"})],
        "negative_slope": [BELOW_1],
        "shared": ["boolean"],
        "input_dropout": [BELOW_1],
        "hidden_dropout": [BELOW_1],
    }

    hidden: Sequence[int] = (8, 8)
    dense: bool | Literal["input", "all"] = False
    negative_slope: float = 0.0
    shared: bool = False
    input_dropout: float = 0.0
    hidden_dropout: float = 0.0

    def __post_init__(self) -> None:
        """Check what can be checked without data."""
        super().__post_init__()
        if self.shared and self.loss == "softmax":
            raise ValueError("shared is True and loss 'softmax'; hidden layers are shared by labels of one output each")

    def n_models(self, n_labels: int) -> int:
        return 1 if self.shared else n_labels

    def widths(self, n_labels: int) -> list[int]:
        """Return the widths of a model's layers in training, the output layer last."""
        n_outputs = self.n_classes if self.loss == "softmax" else n_labels if self.shared else 1
        return [*self.hidden, n_outputs]

    def widths_on_inputs(self, n_labels: int) -> list[int]:
        """Return the widths of the layers that read the inputs."""
        widths = self.widths(n_labels)
        return widths if self.dense else widths[:1]

    def n_columns(self, n_labels: int) -> int:
        return sum(self.widths_on_inputs(n_labels)) * self.n_models(n_labels)

    def new_models(self, n_inputs: int, n_labels: int, streams: Sequence[SeedStreams]) -> BatchedMlps:
        return BatchedMlps(n_inputs, n_labels, self, streams)


class BatchedMlps(BatchedModels[ReluNetwork]):
    """S x L perceptrons: the weights on the inputs of all layers that read them are one table, (S * d, L * H)."""

    def __init__(self, n_inputs: int, n_labels: int, settings: MlpSettings, streams: Sequence[SeedStreams]) -> None:
        """Draw the first weights as torch's Linear does; the networks of a seed start alike."""
        self._settings, self._streams = settings, streams
        self.loss, self.shares_labels = settings.loss, settings.shared
        self._widths = settings.widths(n_labels)
        self._on_inputs = settings.widths_on_inputs(n_labels)
        self._reads_all = settings.dense in (True, "all")
        n_labels = settings.n_models(n_labels)
        n_seeds, total = len(streams), sum(self._on_inputs)
        self._shape = (n_seeds, n_labels)
        self._column_starts = np.concatenate(([0], np.cumsum(self._on_inputs))).tolist()
        table = torch.empty(n_seeds, n_inputs, n_labels, total)
        links, biases = [], []
        for layer, width in enumerate(self._widths):
            n_linked = self._n_linked(layer)
            reads_inputs = layer < len(self._on_inputs)
            limit = 1 / math.sqrt(n_linked + n_inputs * reads_inputs)
            link, bias = torch.empty(n_seeds, n_labels, width, n_linked), torch.empty(n_seeds, n_labels, 1, width)
            for seed, stream in enumerate(streams):
                if reads_inputs:
                    table[seed][..., self._columns(layer)] = _uniform(stream, (n_inputs, 1, width), limit)
                link[seed] = _uniform(stream, (1, width, n_linked), limit)
                bias[seed] = _uniform(stream, (1, 1, width), limit)
            links.append(link)
            biases.append(bias)
        self.parameters = [
            Parameter(table.view(n_seeds * n_inputs, -1), 2, True, (n_seeds, n_inputs, n_labels, total)),
            *(Parameter(link, 1, True) for link in links[1:]),
            *(Parameter(bias, 1, False) for bias in biases),
        ]

    def _n_linked(self, layer: int) -> int:
        """Return how many hidden neurons a layer reads."""
        if layer == 0:
            return 0
        return sum(self._widths[:layer]) if self._reads_all else self._widths[layer - 1]

    def _columns(self, layer: int) -> slice:
        """Return the layer's columns among those of a network in the table."""
        return slice(self._column_starts[layer], self._column_starts[layer + 1])

    def _unpack(self, values: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], list[Tensor]]:
        """Return table, links (an empty one for layer 0) and biases."""
        n_layers = len(self._widths)
        return values[0], [values[0].new_empty(0), *values[1:n_layers]], list(values[n_layers:])

    def outputs(self, rows: InputRows, values: Sequence[Tensor]) -> Tensor:
        """Return the outputs (S, L, n, o), nothing dropped."""
        tables = values[0].view(self._shape[0], rows.n_inputs, -1)
        products = torch.stack([rows.times(table) for table in tables])
        return self._by_label(self._forward(values, products, None)[-1])

    def _by_label(self, outputs: Tensor) -> Tensor:
        """Turn outputs (S, 1, b, L) of shared layers into (S, L, b, 1), and back; others stay as they are."""
        return outputs.transpose(1, 3).contiguous() if self._settings.shared else outputs

    def _forward(self, values: Sequence[Tensor], products: Tensor, masks: list[Tensor] | None) -> list[Tensor]:
        """Return every layer's activations, the outputs last, (S, L, b, width) each.

        The products (S, b, L * H) are of the inputs with the table; the activations of each hidden layer are multiplied
        with its mask, if there are masks.
        """
        _, links, biases = self._unpack(values)
        n_seeds, n_labels = self._shape
        on_inputs = products.view(n_seeds, -1, n_labels, self._column_starts[-1]).transpose(1, 2)
        activations: list[Tensor] = []
        for layer, bias in enumerate(biases):
            z = None
            if layer < len(self._on_inputs):
                z = on_inputs[..., self._columns(layer)] + bias
            if layer > 0:
                read = self._read(activations).flatten(0, 1)
                added = bias if z is None else z
                z = torch.baddbmm(added.flatten(0, 1), read, links[layer].flatten(0, 1).transpose(1, 2))
                z = z.view(n_seeds, n_labels, -1, self._widths[layer])
            assert z is not None
            if layer < len(biases) - 1:
                z = torch.nn.functional.leaky_relu_(z, self._settings.negative_slope)
                if masks is not None:
                    z = z * masks[layer]
            activations.append(z)
        return activations

    def _read(self, activations: list[Tensor]) -> Tensor:
        """Return what the layer after these reads of them."""
        if self._reads_all and len(activations) > 1:
            return torch.cat(activations, dim=-1)
        return activations[-1]

    def step_gradients(self, rows: InputRows, chosen: IntArray, targets: Tensor, weights: Tensor) -> None:
        settings = self._settings
        draws = [stream.dropout for stream in self._streams]
        batch = rows.batch(chosen, settings.input_dropout, draws)
        values = [parameter.values for parameter in self.parameters]
        products = batch.times(values[0])
        scale = 1 / (1 - settings.input_dropout)
        if settings.input_dropout:
            products *= scale
        masks = self._hidden_masks(chosen.shape[1])
        activations = self._forward(values, products, masks)
        smoothing = settings.schedule.label_smoothing
        delta = loss_derivatives(self.loss, self._by_label(activations[-1]), targets, weights, smoothing)
        delta = self._by_label(delta)
        on_inputs = self._backward(values, activations, masks, delta)
        if settings.input_dropout:
            on_inputs *= scale
        self.parameters[0].set_gradient(batch.transposed_times(on_inputs))

    def _hidden_masks(self, n_rows: int) -> list[Tensor] | None:
        p = self._settings.hidden_dropout
        if not p:
            return None
        draws = [
            [stream.dropout.random((1, n_rows, width), dtype=np.float32) >= p for stream in self._streams]
            for width in self._settings.hidden
        ]
        return [torch.from_numpy(np.stack(draw).astype(np.float32) / (1 - p)) for draw in draws]

    def _backward(
        self, values: Sequence[Tensor], activations: list[Tensor], masks: list[Tensor] | None, delta: Tensor
    ) -> Tensor:
        """Write the gradients of links and biases; return the derivatives by the products, (S, b, L * H)."""
        _, links, _ = self._unpack(values)
        _, link_gradients, bias_gradients = self._unpack([parameter.gradient for parameter in self.parameters])
        n_seeds, n_labels = self._shape
        n_rows = delta.shape[2]
        on_inputs = delta.new_empty(n_seeds, n_rows, n_labels, self._column_starts[-1])
        by_activation: list[Tensor | None] = [None] * len(activations)
        by_activation[-1] = delta
        for layer in reversed(range(len(activations))):
            d = by_activation[layer]
            assert d is not None
            if layer < len(activations) - 1:
                d = d * masks[layer] if masks is not None else d
                d = torch.where(activations[layer] > 0, d, d * self._settings.negative_slope)
            torch.sum(d, 2, keepdim=True, out=bias_gradients[layer])
            if layer < len(self._on_inputs):
                on_inputs[..., self._columns(layer)] = d.transpose(1, 2)
            if layer > 0:
                flat = d.reshape(-1, n_rows, self._widths[layer])
                read = self._read(activations[:layer]).flatten(0, 1)
                torch.bmm(flat.transpose(1, 2), read, out=link_gradients[layer].flatten(0, 1))
                back = torch.bmm(flat, links[layer].flatten(0, 1)).view(n_seeds, n_labels, n_rows, -1)
                first = 0 if self._reads_all else layer - 1
                for earlier, part in zip(
                    range(first, layer), torch.split(back, self._widths[first:layer], dim=-1), strict=True
                ):
                    so_far = by_activation[earlier]
                    by_activation[earlier] = part if so_far is None else so_far + part
        return on_inputs.flatten(2)

    def network(self, values: Sequence[Tensor], seed: int, label: int) -> ReluNetwork:
        shared = self._settings.shared
        table, *others = (
            parameter.of_models(value)[seed, 0 if shared else label].double().numpy()
            for parameter, value in zip(self.parameters, values, strict=True)
        )
        links, biases = others[: len(self._widths) - 1], others[len(self._widths) - 1 :]
        weights = []
        for layer in range(len(self._widths)):
            parts = [links[layer - 1]] if layer else []
            if layer < len(self._on_inputs):
                parts.append(table[:, self._columns(layer)].T)
            weights.append(np.concatenate(parts, axis=1))
        biases = [bias[0] for bias in biases]
        if shared:
            weights[-1], biases[-1] = weights[-1][label : label + 1], biases[-1][label : label + 1]
        slope, head = self._settings.negative_slope, self._settings.head
        dense = self._settings.dense if len(self._widths) > 1 else False
        return ReluNetwork(weights, biases, negative_slope=slope, dense=dense, head=head)


def _uniform(stream: SeedStreams, shape: tuple[int, ...], limit: float) -> Tensor:
    return torch.from_numpy(stream.weights.uniform(-limit, limit, shape).astype(np.float32))
