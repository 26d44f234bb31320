"""ReluNetwork: the fully-connected (leaky) ReLU networks that OTR maps to trees, in plain numpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.core.arrays import BoolArray, FloatArray, as_states, read_only, with_read_only_arrays
from otr.core.domain import Box, Domain, as_domain
from otr.core.head import Head
from otr.core.heads import Identity
from otr.errors import InvalidNetworkError

Dense = Literal[False, "input", "all"]


@dataclass(frozen=True)
class UnitForm:
    """A network seen unit by unit: u = links @ a + inputs @ x + offsets, with a the n hidden activations in order.

    The first n rows are the hidden neurons' pre-activations, the last o rows the outputs. `links` is zero on and
    above the diagonal, as a neuron is fed by earlier layers only.
    """

    links: FloatArray  # (n + o, n)
    inputs: FloatArray  # (n + o, d)
    offsets: FloatArray  # (n + o,)
    layer_starts: tuple[int, ...]  # first row of every layer, the output layer last

    def forms(self, patterns: BoolArray, negative_slope: float, n_layers: int | None = None) -> FloatArray:
        """Return the affine forms [P | v] (k, n_units, d + 1) of the units of the first `n_layers` layers, or of all.

        `patterns` (k, n) are the activations of the hidden neurons of all layers before the last one asked for, or
        more.
        """
        layers = tuple(zip(self.layer_starts, (*self.layer_starts[1:], len(self.inputs)), strict=True))[:n_layers]
        gates = np.where(patterns, 1.0, negative_slope)
        own = np.column_stack((self.inputs, self.offsets))
        forms = np.empty((len(patterns), layers[-1][1], own.shape[1]))
        for start, stop in layers:
            rows = slice(start, stop)
            forms[:, rows] = own[rows]
            if start:
                forms[:, rows] += (self.links[rows, :start] * gates[:, None, :start]) @ forms[:, :start]
        return forms


class ReluNetwork:
    """A fully-connected network with ReLU or leaky ReLU hidden layers, float64 and read-only.

        a_0 = x,  z_l = W_l a_{l-1} + b_l,  a_l = max(z_l, negative_slope * z_l),  y = W_out a_L + b_out

    With dense links the layers after the first, and the output layer, read more than a_{l-1}:
    ``dense="input"``: concat(a_{l-1}, x); ``dense="all"`` or True: concat(a_1, ..., a_{l-1}, x).

    Attributes:
        weights, biases: one entry a layer, the output layer last; weights[l] is (n_l, columns read), biases[l] (n_l,).
        negative_slope: slope of the activation below zero, 0 for ReLU.
        dense: False, "input" or "all".
        head: from y to the answer.
        domain: where the network equals the original policy (`from_sb3` with a clip on the observations), the default
            of functions that ask for a domain; None for all of R^d.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # two neurons: |x|
        >>> net.predict([[-2.0], [3.0]])
        array([[2.],
               [3.]])
        >>> net.patterns([[-2.0], [3.0]])  # which neurons are on
        array([[False,  True],
               [ True, False]])
    """

    def __init__(
        self,
        weights: Sequence[ArrayLike],
        biases: Sequence[ArrayLike],
        *,
        negative_slope: float = 0.0,
        dense: bool | Literal["input", "all"] = False,
        head: Head | None = None,
        domain: Domain | Box | None = None,
    ) -> None:
        """Copy and check the arrays; a single weight matrix makes a linear model, with no hidden layer.

        Raises:
            InvalidNetworkError: shapes that do not chain (the layer is named), numbers that are not finite, a slope
                outside [0, 1), an unknown kind of dense links, or a head that does not fit.
            ValueError: the domain is no box of as many inputs.
        """
        if not isinstance(dense, bool) and dense not in ("input", "all"):
            raise InvalidNetworkError(f"dense is {dense!r}, expected False, True, 'input' or 'all'")
        if not 0.0 <= negative_slope < 1.0:
            raise InvalidNetworkError(f"negative_slope is {negative_slope}, expected 0 <= negative_slope < 1")
        self.dense: Dense = "all" if dense is True else dense
        self.negative_slope = float(negative_slope)
        if head is not None and not isinstance(head, Head):
            raise InvalidNetworkError(f"head is {head!r}, expected an instance such as otr.TanhBox(low, high)")
        self.head: Head = Identity() if head is None else head
        self.weights, self.biases = _checked_layers(weights, biases, self.dense)
        self.head.check(self.n_outputs)
        self.domain = None if domain is None else as_domain(domain, self.n_inputs)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(with_read_only_arrays(state))

    @property
    def n_inputs(self) -> int:
        """Number of inputs d."""
        return int(self.weights[0].shape[1])

    @property
    def n_outputs(self) -> int:
        """Number of affine outputs o."""
        return int(self.weights[-1].shape[0])

    @property
    def n_answers(self) -> int:
        """Number of labels, or of values in an answer."""
        count = self.head.n_labels if self.head.gives_labels else self.head.n_answers
        return count(self.n_outputs)

    @property
    def hidden_widths(self) -> tuple[int, ...]:
        """Number of neurons in each hidden layer."""
        return tuple(len(bias) for bias in self.biases[:-1])

    @property
    def n_hidden(self) -> int:
        """Number of hidden neurons n, the depth of the full tree before the head's tests."""
        return sum(self.hidden_widths)

    def forward(self, X: ArrayLike) -> FloatArray:
        """Return the affine outputs y: (n, o) for states (n, d), (o,) for one state (d,)."""
        return self._run(as_states(X, self.n_inputs), None)

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the head's answers: (n, o) values or (n,) labels; without the first axis for one state."""
        return self.head(self.forward(X))

    def patterns(self, X: ArrayLike) -> BoolArray:
        """Return the activation patterns: (n, n_hidden), True where a hidden pre-activation is above zero."""
        return self.patterns_and_outputs(X)[0]

    def patterns_and_outputs(self, X: ArrayLike) -> tuple[BoolArray, FloatArray]:
        """Return `patterns(X)` and `forward(X)` from one pass."""
        states = as_states(X, self.n_inputs)
        patterns = np.empty((*states.shape[:-1], self.n_hidden), dtype=np.bool_)
        return patterns, self._run(states, patterns)

    def _run(self, X: FloatArray, patterns: BoolArray | None) -> FloatArray:
        """Return the outputs, and write the activation patterns to `patterns` if it is given."""
        activations: FloatArray | None = None
        start = 0
        for layer in range(len(self.weights) - 1):
            z = self._affine(layer, X, activations)
            if patterns is not None:
                stop = start + z.shape[-1]
                np.greater(z, 0.0, out=patterns[..., start:stop])
                start = stop
            np.maximum(z, self.negative_slope * z if self.negative_slope else 0.0, out=z)
            keep_all = self.dense == "all" and activations is not None
            activations = np.concatenate((activations, z), axis=-1) if keep_all else z  # type: ignore[arg-type]
        return self._affine(-1, X, activations)

    def _affine(self, layer: int, X: FloatArray, activations: FloatArray | None) -> FloatArray:
        """Return one layer's pre-activations; `activations` are what it reads from earlier layers."""
        W = self.weights[layer]
        if activations is None:
            z = X @ W.T
        elif self.dense is False:
            z = activations @ W.T
        else:
            width = activations.shape[-1]
            z = activations @ W[:, :width].T
            z += X @ W[:, width:].T
        z += self.biases[layer]
        return z

    def unit_form(self) -> UnitForm:
        """Return the network unit by unit, the form in which depth, width and dense links no longer matter."""
        n, d, o = self.n_hidden, self.n_inputs, self.n_outputs
        links, inputs = np.zeros((n + o, n)), np.zeros((n + o, d))
        starts = np.concatenate(([0], np.cumsum(self.hidden_widths))).astype(int).tolist()
        for layer, W in enumerate(self.weights):
            rows = slice(starts[layer], starts[layer] + len(W))
            if layer == 0:
                inputs[rows] = W
                continue
            first = 0 if self.dense == "all" else starts[layer - 1]
            width = starts[layer] - first
            links[rows, first : starts[layer]] = W[:, :width]
            if self.dense is not False:
                inputs[rows] = W[:, width:]
        return UnitForm(links, inputs, np.concatenate(self.biases), tuple(starts))

    def gains(self) -> FloatArray:
        """Return by how much an output can change, at most, with each hidden neuron's activation, times that: (n,)."""
        units, n = self.unit_form(), self.n_hidden
        gains = np.concatenate((np.zeros((n, self.n_outputs)), np.eye(self.n_outputs)))
        for neuron in reversed(range(n)):
            gains[neuron] = np.abs(units.links[:, neuron]) @ gains
        return np.asarray(gains[:n].max(axis=1))

    def without_dead_neurons(self) -> ReluNetwork:
        """Return the network without the hidden neurons that reach no output; every layer keeps one at least."""
        units = self.unit_form()
        layers = list(pairwise(units.layer_starts))
        alive = np.ones(self.n_hidden + self.n_outputs, dtype=np.bool_)
        for start, stop in reversed(layers):
            alive[start:stop] = units.links[alive, start:stop].any(axis=0)
            alive[start] |= not alive[start:stop].any()
        if alive.all():
            return self
        kept = [alive[start:stop] for start, stop in (*layers, (self.n_hidden, self.n_hidden + self.n_outputs))]
        weights, biases = [], []
        for layer, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            read = kept[:layer] if self.dense == "all" else kept[max(layer - 1, 0) : layer]
            n_of_inputs = W.shape[1] - sum(map(len, read))
            columns = np.concatenate((*read, np.ones(n_of_inputs, dtype=np.bool_)))
            weights.append(W[kept[layer]][:, columns])
            biases.append(b[kept[layer]])
        return self.replace(weights=weights, biases=biases)

    def fold_input_normalisation(self, mean: ArrayLike, scale: ArrayLike) -> ReluNetwork:
        """Return the network that answers on raw x as this one does on (x - mean) / scale; so does its domain.

        Args:
            mean, scale: (d,) each, or numbers; scale finite and not zero.

        Raises:
            InvalidNetworkError: mean or scale is not finite, scale has a zero, or a shape is wrong.
        """
        d = self.n_inputs
        mean, scale = np.asarray(mean, dtype=np.float64), np.asarray(scale, dtype=np.float64)
        if mean.shape not in ((), (d,)) or scale.shape not in ((), (d,)):
            raise InvalidNetworkError(f"mean has shape {mean.shape} and scale {scale.shape}, expected ({d},) for both")
        if not (np.isfinite(mean).all() and np.isfinite(scale).all() and (scale != 0).all()):
            raise InvalidNetworkError("mean and scale must be finite and scale must have no zero")
        weights, biases = [], []
        for layer, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if layer > 0 and self.dense is False:
                weights.append(W)
                biases.append(b)
                continue
            on_x = W[:, W.shape[1] - d :] / scale
            weights.append(np.concatenate((W[:, : W.shape[1] - d], on_x), axis=1))
            biases.append(b - on_x @ np.broadcast_to(mean, (d,)))
        domain = self.domain
        if domain is not None:
            domain = Domain(*np.sort((domain.low * scale + mean, domain.high * scale + mean), axis=0))
        return self.replace(weights=weights, biases=biases, domain=domain)

    def replace(self, **changes: Any) -> ReluNetwork:
        """Return the network with other layers or settings, checked like any network, and all else as it is.

        ``network.replace(head=otr.Argmax())`` answers with the largest output's label.

        Args:
            changes: the constructor's arguments by name.

        Raises:
            InvalidNetworkError: the changed network is not valid.
            TypeError: a network has no such argument.
            ValueError: the domain is no box of as many inputs.
        """
        names = ("weights", "biases", "negative_slope", "dense", "head", "domain")
        return ReluNetwork(**{name: getattr(self, name) for name in names} | changes)

    def __repr__(self) -> str:
        widths = " -> ".join(str(width) for width in (self.n_inputs, *self.hidden_widths, self.n_outputs))
        return f"ReluNetwork({widths}, negative_slope={self.negative_slope}, dense={self.dense!r}, head={self.head!r})"


def _checked_layers(
    weights: Sequence[ArrayLike], biases: Sequence[ArrayLike], dense: Dense
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    """Return read-only float64 copies of the layers, or raise InvalidNetworkError naming the layer at fault."""
    if len(weights) != len(biases) or len(weights) == 0:
        raise InvalidNetworkError(
            f"{len(weights)} weight matrices and {len(biases)} bias vectors; give one of each per layer, at least one"
        )
    Ws = tuple(_numbers(W, f"the weight of layer {layer}") for layer, W in enumerate(weights))
    bs = tuple(_numbers(b, f"the bias of layer {layer}") for layer, b in enumerate(biases))
    widths: list[int] = []
    for layer, (W, b) in enumerate(zip(Ws, bs, strict=True)):
        where = f"layer {layer} of {len(Ws)}"
        if W.ndim != 2 or b.shape != W.shape[:1] or W.size == 0:
            raise InvalidNetworkError(
                f"{where}: weight has shape {W.shape} and bias {b.shape}, expected (n_out, n_in) and (n_out,)"
            )
        expected = _columns_read(widths, Ws[0].shape[1], dense)
        if W.shape[1] != expected:
            raise InvalidNetworkError(
                f"{where}: weight has {W.shape[1]} columns, the layer reads {expected} values (dense={dense!r})"
            )
        if not (np.isfinite(W).all() and np.isfinite(b).all()):
            raise InvalidNetworkError(f"{where}: a weight or bias is not finite (NaN or infinite)")
        widths.append(len(b))
    return Ws, bs


def _numbers(values: ArrayLike, what: str) -> FloatArray:
    """Return a read-only float64 copy, or raise InvalidNetworkError naming what is no array of real numbers."""
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "fiub":
            raise TypeError(f"its type is {given.dtype}")
        return read_only(np.array(given, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InvalidNetworkError(f"{what} is no array of real numbers: {error}") from error


def _columns_read(widths: Sequence[int], n_inputs: int, dense: Dense) -> int:
    """Return how many values the layer after hidden layers of `widths` reads."""
    if not widths:
        return n_inputs
    if dense == "all":
        return sum(widths) + n_inputs
    return widths[-1] + (n_inputs if dense == "input" else 0)


def require_relu_network(network: object) -> None:
    """Raise TypeError for anything but a ReluNetwork."""
    if not isinstance(network, ReluNetwork):
        raise TypeError(
            f"network is a {type(network).__name__}, expected a ReluNetwork; a PatternTree has .network; no tree "
            "equals a policy of other units; a tree can imitate it: otr.imitate(policy, env)"
        )
