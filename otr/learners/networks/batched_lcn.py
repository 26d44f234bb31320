"""Many locally constant networks trained as one batched model, labels x seeds (Lee & Jaakkola 2020).

The output reads the Jacobians J_i = sum_k T_ik W_k, where T (M, M) depends on the row through the M derivatives of its
neurons. With A = G W^T (M, M), which no row enters, G . J is the sum of T * A: the Jacobians (M, d) of the rows are
never built, and a step costs two products of the rows with W and two of W with G.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from otr.core.arrays import FloatArray, IntArray
from otr.learners.base.parameters import AT_LEAST_0, AT_LEAST_1, BELOW_1, Constraints
from otr.learners.networks.batched_models import BatchedModels, Parameter, SeedStreams, loss_derivatives
from otr.learners.networks.first_layer import InputRows
from otr.learners.networks.labels_and_seeds import NetworkSettings
from otr.learners.networks.lcn_network import LcnNetwork

_EVALUATION_ROWS = 1024


@dataclass(frozen=True, kw_only=True)
class LcnSettings(NetworkSettings[LcnNetwork]):
    """Shape and training of locally constant networks.

    With the logistic loss, g has two outputs whose difference is the logit, as in LCN's code; they become one in the
    end. In epoch e of E the activation is alpha relu + (1 - alpha) softplus and its derivative alpha [z > 0] +
    (1 - alpha) sigmoid(z), with alpha = e / E; scores are always those of the ReLU network without drops.

    Attributes:
        depth: neurons M.
        hidden: width of g's hidden layer; 0 for a linear g.
        drop_connect: share p of each neuron's weights that are dropped when its sign is computed, redrawn for every row
            and neuron; the rest is scaled up. The derivatives themselves are taken with all weights.
        loss, n_classes, schedule: see `NetworkSettings`.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        **NetworkSettings._parameter_constraints,
        "depth": [AT_LEAST_1],
        "hidden": [AT_LEAST_0],
        "drop_connect": [BELOW_1],
    }

    depth: int = 12
    hidden: int = 0
    drop_connect: float = 0.0

    def n_columns(self, n_labels: int) -> int:
        return n_labels * self.depth

    def new_models(self, n_inputs: int, n_labels: int, streams: Sequence[SeedStreams]) -> BatchedLcns:
        return BatchedLcns(n_inputs, n_labels, self, streams)


class BatchedLcns(BatchedModels[LcnNetwork]):
    """S x L networks; the small products after T go through torch's autograd, those with the inputs by hand."""

    def __init__(self, n_inputs: int, n_labels: int, settings: LcnSettings, streams: Sequence[SeedStreams]) -> None:
        """Draw the first weights as torch's Linear does; the networks of a seed start alike."""
        self.loss = settings.loss
        self._settings, self._streams = settings, streams
        self._alpha = 1.0
        S, M = len(streams), settings.depth
        o = {"logistic": 2, "softmax": settings.n_classes, "squared": 1, "poisson": 1}[settings.loss]
        q = settings.hidden or o
        self._shape = (S, n_labels, M, q)
        shapes = {
            "table": (n_inputs, n_labels, M),
            "U": (n_labels, M, M),
            "b": (n_labels, M),
            "G": (n_labels, q, M, n_inputs),
            "h": (n_labels, q, M),
            "offset": (n_labels, q),
        }
        if settings.hidden:
            shapes |= {"V": (n_labels, o, q), "v": (n_labels, o)}
        neuron = 1 / np.sqrt(n_inputs + np.arange(M))  # torch's limit: neuron i reads the inputs and i neurons
        first = 1 / math.sqrt(M * (n_inputs + 1))
        limits: dict[str, float | FloatArray] = {
            "table": neuron,
            "U": np.tril(neuron[:, None].repeat(M, 1), -1),
            "b": neuron,
        }
        limits |= {"G": first, "h": first, "offset": first}
        limits |= {"V": 1 / math.sqrt(q), "v": 1 / math.sqrt(q)}
        self.parameters, self._names = [], list(shapes)
        for name, shape in shapes.items():
            label_axis = 1 if name == "table" else 0
            one = tuple(1 if axis == label_axis else size for axis, size in enumerate(shape))
            values = torch.empty(S, *shape)
            for seed, stream in enumerate(streams):
                draw = stream.weights.uniform(-1.0, 1.0, one) * limits[name]
                values[seed] = torch.from_numpy(draw.astype(np.float32))
            full = tuple(values.shape)
            if name == "table":
                values = values.view(S * n_inputs, -1)
            penalised = name in ("table", "U", "G", "h", "V")
            self.parameters.append(Parameter(values, label_axis + 1, penalised, full))

    def start_epoch(self, epoch: int, n_epochs: int) -> None:
        """Anneal from softplus to ReLU."""
        self._alpha = epoch / n_epochs

    def _named(self, values: Sequence[Tensor]) -> dict[str, Tensor]:
        return dict(zip(self._names, values, strict=True))

    def _weights(self, table: Tensor) -> Tensor:
        """Return the table as (S, L, d, M)."""
        S, L, M, _ = self._shape
        return table.view(S, -1, L, M).transpose(1, 2)

    def _pairs(self, named: dict[str, Tensor]) -> Tensor:
        """Return A = G W^T: (S, L, q * M, M)."""
        return named["G"].flatten(2, 3) @ self._weights(named["table"])

    def outputs(self, rows: InputRows, values: Sequence[Tensor]) -> Tensor:
        """Return the outputs (S, L, n, o) of the ReLU networks; for the logistic loss the logit."""
        S, L, M, _ = self._shape
        named = self._named(values)
        A = self._pairs(named)
        products = torch.stack([rows.times(table) for table in named["table"].view(S, rows.n_inputs, -1)])
        products = products.view(S, -1, L, M).transpose(1, 2)
        parts = [self._g(named, A, part, part, None, 1.0) for part in torch.split(products, _EVALUATION_ROWS, dim=2)]
        outputs = torch.cat(parts, dim=2)
        return outputs[..., 1:] - outputs[..., :1] if self.loss == "logistic" else outputs

    def _g(
        self, named: dict[str, Tensor], A: Tensor, seen: Tensor, products: Tensor, masks: Tensor | None, alpha: float
    ) -> Tensor:
        """Return g's outputs, (S, L, b, o).

        The neurons see the products W x (S, L, b, M) with weights dropped, as `seen`, and links times `masks` (S, 1, b,
        M, M); `A` is that of `_pairs`, `alpha` the share of the ReLU.
        """
        S, L, M, q = self._shape
        U = named["U"].unsqueeze(2)
        U_seen = U if masks is None else U * masks
        activations: list[Tensor] = []
        T: list[Tensor] = []
        for i in range(M):
            z = seen[..., i] + named["b"][..., i].unsqueeze(-1)
            row = torch.nn.functional.one_hot(torch.tensor(i), M).to(z.dtype).expand(*z.shape, M)
            if i:
                z = z + (U_seen[..., i, :i] * torch.stack(activations, dim=-1)).sum(-1)
                row = row + (U[..., i, :i, None] * torch.stack(T, dim=-2)).sum(-2)
            step = (z > 0).to(z.dtype)
            if alpha < 1.0:
                slope = alpha * step + (1 - alpha) * z.sigmoid()
                activations.append(alpha * z.relu() + (1 - alpha) * torch.nn.functional.softplus(z))
            else:
                slope = step
                activations.append(z.relu())
            T.append(slope.unsqueeze(-1) * row)
        transfer = torch.stack(T, dim=-2)  # (S, L, b, M, M)
        offsets = torch.stack(activations, dim=-1) - (transfer * products.unsqueeze(-2)).sum(-1)
        first = transfer.flatten(3) @ A.view(S, L, q, M * M).transpose(2, 3)
        first = first + offsets @ named["h"].transpose(2, 3) + named["offset"].unsqueeze(2)
        if "V" not in named:
            return first
        return first.relu() @ named["V"].transpose(2, 3) + named["v"].unsqueeze(2)

    def step_gradients(self, rows: InputRows, chosen: IntArray, targets: Tensor, weights: Tensor) -> None:
        S, L, M, _ = self._shape
        p = self._settings.drop_connect
        draws = [stream.dropout for stream in self._streams]
        named = self._named([parameter.values for parameter in self.parameters])
        batch = rows.batch(chosen)

        def by_label(flat: Tensor) -> Tensor:
            return flat.view(S, -1, L, M).transpose(1, 2).contiguous()

        products = by_label(batch.times(named["table"])).requires_grad_()
        seen, input_masks, link_masks = products, None, None
        if p:
            input_masks = batch.draw_masks(draws, p, M)
            seen = by_label(batch.masked_times(named["table"], input_masks)).div_(1 - p).requires_grad_()
            kept = [draw.random((1, chosen.shape[1], M, M), dtype=np.float32) >= p for draw in draws]
            link_masks = torch.from_numpy(np.stack(kept).astype(np.float32) / (1 - p))
        A = self._pairs(named).requires_grad_()
        small = {name: value.detach().requires_grad_() for name, value in named.items() if name not in ("table", "G")}
        with torch.enable_grad():
            outputs = self._g(small, A, seen, products, link_masks, self._alpha)
        smoothing = self._settings.schedule.label_smoothing
        if self.loss == "logistic":
            logits = outputs.detach()[..., 1:] - outputs.detach()[..., :1]
            derivatives = loss_derivatives(self.loss, logits, targets, weights, smoothing)
            derivatives = torch.cat((-derivatives, derivatives), dim=-1)
        else:
            derivatives = loss_derivatives(self.loss, outputs.detach(), targets, weights, smoothing)
        wanted = [A, products, *small.values()] + ([] if seen is products else [seen])
        # A network of one neuron has no links; their gradient is 0.
        made = torch.autograd.grad(outputs, wanted, derivatives, allow_unused=True, materialize_grads=True)
        d_A, d_products, *others = made
        by_rows = d_products.transpose(1, 2).reshape(S, -1, L * M)
        table_gradient = batch.transposed_times(by_rows)
        if input_masks is not None:
            d_seen = others.pop() / (1 - p)
            by_rows = d_seen.transpose(1, 2).reshape(S, -1, L * M)
            table_gradient += batch.transposed_masked_times(by_rows, input_masks)
        G = named["G"].flatten(2, 3)  # (S, L, q * M, d)
        self._weights(table_gradient).add_(G.transpose(2, 3) @ d_A)
        gradients = {"table": table_gradient, "G": (d_A @ self._weights(named["table"]).transpose(2, 3))}
        gradients |= dict(zip(small, others, strict=True))
        gradients["U"] = gradients["U"].tril(-1)
        for name, parameter in zip(self._names, self.parameters, strict=True):
            parameter.set_gradient(gradients[name])

    def network(self, values: Sequence[Tensor], seed: int, label: int) -> LcnNetwork:
        one = {
            name: parameter.of_models(value)[seed, label].double().numpy()
            for name, parameter, value in zip(self._names, self.parameters, values, strict=True)
        }
        G, h, offset, V, v = (one.get(name) for name in ("G", "h", "offset", "V", "v"))
        if self.loss == "logistic":
            if V is not None and v is not None:
                V, v = V[1:] - V[:1], v[1:] - v[:1]
            else:
                G, h, offset = (two[1:] - two[:1] for two in (one["G"], one["h"], one["offset"]))
        assert G is not None and h is not None and offset is not None
        return LcnNetwork(one["table"].T.copy(), one["U"], one["b"], G, h, offset, V, v, self._settings.head)
