"""A network from an ONNX graph, node by node: every value is affine in the last hidden layer, or the end of all."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Argmax, Identity, Sign, TanhBox
from otr.core.network import ReluNetwork
from otr.errors import InvalidNetworkError
from otr.importers.onnx_file import Graph, array_of, attributes, describe, numbers, read_graph
from otr.importers.torch_modules import RELU_REMEDY

if TYPE_CHECKING:
    from collections.abc import Callable

    from onnx import NodeProto

_ACCEPTED = (
    "accepted are Gemm, MatMul, Add, Sub, Mul and Div with constants, Relu, LeakyRelu, at the end Tanh, Clip, Max and "
    "Min with constants or ArgMax, and Flatten, Reshape, Identity, Cast and Dropout that change no number"
)
_LIMIT_ENTRIES = 2**24  # of a matrix: a product of thin ones can be far larger than the file
_FLOAT, _INT32, _INT64, _DOUBLE = 1, 6, 7, 11  # of onnx.TensorProto.DataType
_DECIDED_BY: dict[str, Head] = {"Sigmoid": Sign(), "Softmax": Argmax(), "LogSoftmax": Argmax()}


@dataclass(frozen=True)
class _Signal:
    """A value of the graph that depends on the states: rows of `width` numbers.

    Before the end it is ``scale * a + offset`` of the activations a (the states, at first) where `is_activated`, else
    the outputs of the last layer. After a Tanh it is ``half * tanh(y) + middle``; all of it lies in [low, high].
    """

    shape: tuple[int, ...]  # 0 for the number of states
    layers: tuple[tuple[FloatArray, FloatArray], ...] = ()
    slopes: frozenset[float] = frozenset()
    is_activated: bool = True
    scale: FloatArray | float = 1.0
    offset: FloatArray | float = 0.0
    end: str = ""  # the operator of the last step, after which no layer may come
    half: FloatArray | float = 1.0
    middle: FloatArray | float = 0.0
    low: FloatArray | float = -math.inf
    high: FloatArray | float = math.inf

    @property
    def width(self) -> int:
        return self.shape[-1]


def network_of_onnx(given: Any, head: Head | None, output: str | None) -> ReluNetwork:
    """Return the network of an ONNX model; `otr.from_onnx` documents arguments and errors."""
    graph = read_graph(given, output)
    values: dict[str, _Signal | NDArray[Any]] = {graph.input_name: _Signal(_input_shape(graph))}
    for node in graph.nodes:
        operands: list[Any] = []
        for name in node.input:
            if name and name not in values:
                if name not in graph.tensors:
                    raise InvalidNetworkError(f"{describe(node)} reads {name!r}, which is no value; {_ACCEPTED}")
                values[name] = array_of(graph.tensors[name])
            operands.append(values[name] if name else None)
        values[node.output[0]] = _result(node, operands, graph)
    answer = values.get(graph.output_name)
    if not isinstance(answer, _Signal) or not answer.layers:
        raise InvalidNetworkError(f"no Gemm or MatMul lies between {graph.input_name!r} and {graph.output_name!r}")
    return _network(answer, head)


def _input_shape(graph: Graph) -> tuple[int, ...]:
    shape = graph.input_shape
    if len(shape) < 2 or not all(shape[1:]):
        shown = ", ".join(str(size or "?") for size in shape)
        raise InvalidNetworkError(
            f"the input {graph.input_name!r} has the shape ({shown}), expected (n, number of inputs), of which "
            "n alone may be left open; export the policy again with a batch of states"
        )
    return shape


def _result(node: NodeProto, operands: list[Any], graph: Graph) -> Any:
    """Return what a node makes of constants, or of a signal and constants."""
    signals = [operand for operand in operands if isinstance(operand, _Signal)]
    if not signals:
        return _constant(node, operands)
    if len(signals) > 1:
        raise InvalidNetworkError(
            f"{describe(node)} joins two values that depend on the states; only a chain of layers can be read"
        )
    signal = signals[0]
    if node.op_type in ("Identity", "Cast", "Dropout", "Flatten", "Reshape"):
        return _passed_on(node, signal, operands)
    if signal.end and node.op_type in ("Gemm", "MatMul", "Relu", "LeakyRelu", "Tanh"):
        remedy = RELU_REMEDY if signal.end == "Tanh" else "nothing but a scale, a shift and a clip may"
        raise InvalidNetworkError(f"{describe(node)} comes after {signal.end}; {remedy}")
    handler = _HANDLERS.get(node.op_type)
    if handler is None:
        raise InvalidNetworkError(f"{describe(node)} cannot be read; {_ACCEPTED}")
    if len(signal.shape) != 2:
        raise InvalidNetworkError(f"{describe(node)} reads the shape {signal.shape}; put a Flatten before it")
    return handler(node, signal, operands, graph.opset)


def _constant(node: NodeProto, operands: list[Any]) -> NDArray[Any]:
    """Return what a node makes of constants alone, as exporters leave them beside the weights."""
    given = attributes(node)
    if node.op_type == "Constant":
        if "value" in given:
            return array_of(given["value"])
        for name, kind in (("value_float", np.float64), ("value_floats", np.float64), ("value_ints", np.int64)):
            if name in given:
                return np.asarray(given[name], dtype=kind)
    elif node.op_type == "Transpose" and operands[0].ndim == 2 and given.get("perm", [1, 0]) == [1, 0]:
        return np.asarray(operands[0].T)
    elif node.op_type == "Identity":
        return np.asarray(operands[0])
    elif node.op_type == "Cast" and given["to"] in (_FLOAT, _DOUBLE):
        return np.asarray(operands[0], np.float32 if given["to"] == _FLOAT else np.float64).astype(np.float64)
    raise InvalidNetworkError(f"{describe(node)} of constants cannot be read; export the policy with constants folded")


def _passed_on(node: NodeProto, signal: _Signal, operands: list[Any]) -> _Signal:
    """Return the signal after a node that changes no number, or raise InvalidNetworkError."""
    given, shape = attributes(node), signal.shape
    width = math.prod(shape[1:])
    is_same = True
    if node.op_type == "Flatten":
        axis = given.get("axis", 1)
        is_same = axis % len(shape) == 1
        shape = (shape[0], width)
    elif node.op_type == "Reshape":
        wanted = operands[1].tolist() if isinstance(operands[1], np.ndarray) else []
        is_same = len(wanted) == 2 and not given.get("allowzero", 0)
        is_same = is_same and (wanted[0] in (0, shape[0]) or (wanted[0] in (-1, 1) and wanted[1] == width))
        is_same = is_same and wanted[1] in (-1, width)
        shape = (shape[0], width)
    elif node.op_type == "Cast":
        is_same = given["to"] in ((_INT32, _INT64) if signal.end == "ArgMax" else (_FLOAT, _DOUBLE))
    elif node.op_type == "Dropout":
        is_same = len(operands) < 3 or operands[2] is None
    if not is_same:
        raise InvalidNetworkError(f"{describe(node)} changes more than the shape of each state; {_ACCEPTED}")
    return replace(signal, shape=shape)


def _gemm(node: NodeProto, signal: _Signal, operands: list[Any], opset: int) -> _Signal:
    given = attributes(node)
    if operands[0] is not signal or given.get("transA", 0):
        raise InvalidNetworkError(f"{describe(node)} multiplies from the left; expected states in rows as its input A")
    W = given.get("alpha", 1.0) * numbers(operands[1], node)
    layer = _with_layer(node, signal, W if given.get("transB", 0) else W.T)
    if len(operands) < 3 or operands[2] is None:
        return layer
    return _affine(node, layer, 1.0, given.get("beta", 1.0) * _row(node, operands[2], layer.width))


def _matmul(node: NodeProto, signal: _Signal, operands: list[Any], opset: int) -> _Signal:
    if operands[0] is not signal:
        raise InvalidNetworkError(f"{describe(node)} multiplies from the left; expected states in rows as its input A")
    return _with_layer(node, signal, numbers(operands[1], node).T)


def _with_layer(node: NodeProto, signal: _Signal, W: FloatArray) -> _Signal:
    """Return W @ signal, W (n_out, n_in), multiplied with the layer before where no activation lies between."""
    if W.ndim != 2 or W.shape[1] != signal.width or W.size == 0:
        raise InvalidNetworkError(
            f"{describe(node)} has weights of shape {W.T.shape}, expected ({signal.width}, n_out): it reads "
            f"{signal.width} values"
        )
    if signal.is_activated:
        layers = (*signal.layers, (W * signal.scale, W @ np.broadcast_to(signal.offset, signal.width)))
    else:
        *before, (W_before, b_before) = signal.layers
        _require_moderate(node, len(W), W_before.shape[1])
        layers = (*before, (W @ W_before, W @ b_before))
    return replace(signal, shape=(signal.shape[0], len(W)), layers=layers, is_activated=False, scale=1.0, offset=0.0)


def _require_moderate(node: NodeProto | None, rows: int, columns: int) -> None:
    if rows * columns > _LIMIT_ENTRIES:
        where = describe(node) if node is not None else "the last activation"
        raise InvalidNetworkError(
            f"{where} makes a matrix of {rows} x {columns} numbers, the limit is {_LIMIT_ENTRIES:,}; a network of this "
            "width has no tree that can be held"
        )


def _elementwise(node: NodeProto, signal: _Signal, operands: list[Any], opset: int) -> _Signal:
    """Add, Sub, Mul or Div of the signal and a constant."""
    is_first = operands[0] is signal
    constant = _row(node, operands[1 if is_first else 0], signal.width)
    if node.op_type == "Add":
        return _affine(node, signal, 1.0, constant)
    if node.op_type == "Sub":
        return _affine(node, signal, 1.0, -constant) if is_first else _affine(node, signal, -1.0, constant)
    if node.op_type == "Mul":
        return _affine(node, signal, constant, 0.0)
    if not is_first or not constant.all():
        raise InvalidNetworkError(f"{describe(node)} divides by {'zero' if is_first else 'the states'}")
    return _affine(node, signal, 1.0 / constant, 0.0)


def _affine(node: NodeProto, signal: _Signal, scale: FloatArray | float, offset: FloatArray | float) -> _Signal:
    """Return scale * signal + offset, of numbers or rows (width,)."""
    if signal.end:
        if signal.end not in ("Tanh", "Clip") or not np.all(np.asarray(scale) > 0):
            raise InvalidNetworkError(f"{describe(node)} comes after {signal.end}; only shifts and positive scales may")
        signal = replace(signal, low=signal.low * scale + offset, high=signal.high * scale + offset)
        if signal.end == "Tanh":
            return replace(signal, half=signal.half * scale, middle=signal.middle * scale + offset)
    if signal.is_activated:
        return replace(signal, scale=signal.scale * scale, offset=signal.offset * scale + offset)
    *before, (W, b) = signal.layers
    return replace(signal, layers=(*before, (W * np.reshape(scale, (-1, 1)), b * scale + offset)))


def _row(node: NodeProto, value: Any, width: int) -> FloatArray:
    """Return a constant that is added to, or multiplies, every row: (width,)."""
    row = numbers(value, node)
    if math.prod(row.shape[:-1]) != 1 or (row.ndim and row.shape[-1] not in (1, width)):
        raise InvalidNetworkError(f"{describe(node)} has a constant of shape {row.shape}, expected ({width},)")
    return np.broadcast_to(row.ravel(), width)


def _activation(node: NodeProto, signal: _Signal, operands: list[Any], opset: int) -> _Signal:
    if signal.is_activated:
        raise InvalidNetworkError(f"{describe(node)} follows no Gemm or MatMul; put one before it")
    slope = 0.0 if node.op_type == "Relu" else float(np.float32(attributes(node).get("alpha", 0.01)))
    slopes = signal.slopes | {slope}
    if len(slopes) > 1:
        raise InvalidNetworkError(f"activations have the slopes {sorted(slopes)} below zero; one network has one slope")
    return replace(signal, is_activated=True, slopes=slopes)


def _tanh(node: NodeProto, signal: _Signal, operands: list[Any], opset: int) -> _Signal:
    return replace(signal, end="Tanh", low=-math.inf, high=math.inf)


def _clip(node: NodeProto, signal: _Signal, operands: list[Any], opset: int) -> _Signal:
    """Clip, or a Max or Min with a constant."""
    if signal.end not in ("", "Tanh", "Clip"):
        raise InvalidNetworkError(f"{describe(node)} comes after {signal.end}")
    if node.op_type in ("Max", "Min"):
        if len(operands) != 2:
            raise InvalidNetworkError(f"{describe(node)} compares {len(operands)} values, expected one and a constant")
        limit = _row(node, operands[1 if operands[0] is signal else 0], signal.width)
        low, high = (limit, math.inf) if node.op_type == "Max" else (-math.inf, limit)
    elif opset < 11:
        given = attributes(node)
        low, high = given.get("min", -math.inf), given.get("max", math.inf)
    else:
        limits = [_row(node, value, signal.width) if value is not None else None for value in operands[1:]]
        limits += [None] * (2 - len(limits))
        low = -math.inf if limits[0] is None else limits[0]
        high = math.inf if limits[1] is None else limits[1]
    # The later limit wins: Max above high is high again only if high comes after it.
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not (np.all(low < high) and np.all(low < signal.high) and np.all(high > signal.low)):
        raise InvalidNetworkError(f"{describe(node)} leaves one answer only in some output")
    end = signal.end or "Clip"
    return replace(signal, end=end, low=np.maximum(signal.low, low), high=np.minimum(signal.high, high))


def _decision(node: NodeProto, signal: _Signal, operands: list[Any], opset: int) -> _Signal:
    """ArgMax, or Sigmoid and Softmax, before which a head answers the same."""
    given = attributes(node)
    if signal.end and not (node.op_type == "ArgMax" and "Softmax" in signal.end):
        raise InvalidNetworkError(f"{describe(node)} comes after {signal.end}")
    axis = given.get("axis", {"ArgMax": 0, "Sigmoid": 1}.get(node.op_type, -1 if opset >= 13 else 1))
    if axis not in (1, -1) or given.get("select_last_index", 0):
        raise InvalidNetworkError(f"{describe(node)} goes over axis {axis}, expected each state's first largest output")
    return replace(signal, end=node.op_type)


_HANDLERS: dict[str, Callable[[NodeProto, _Signal, list[Any], int], _Signal]] = {
    "Gemm": _gemm,
    "MatMul": _matmul,
    **dict.fromkeys(("Add", "Sub", "Mul", "Div"), _elementwise),
    **dict.fromkeys(("Relu", "LeakyRelu"), _activation),
    "Tanh": _tanh,
    **dict.fromkeys(("Clip", "Max", "Min"), _clip),
    **dict.fromkeys(("ArgMax", "Sigmoid", "Softmax", "LogSoftmax"), _decision),
}


def _network(answer: _Signal, head: Head | None) -> ReluNetwork:
    """Return the network of the last value, with the head of its end."""
    found = _head(answer)
    if answer.end in _DECIDED_BY:
        if head != found:
            raise InvalidNetworkError(
                f"the model ends in {answer.end}; it needs head=otr.{type(found).__name__}(), "
                "as the tree answers with the label and not the probability"
            )
    elif head is not None and answer.end and head != found:
        raise InvalidNetworkError(f"head is {head!r}, the model ends in {answer.end}: {found!r}; leave head out")
    weights, biases = [W for W, _ in answer.layers], [b for _, b in answer.layers]
    if answer.is_activated:  # the activations are the answer, up to a scale: one more layer that passes them on
        _require_moderate(None, answer.width, answer.width)
        weights.append(np.eye(answer.width) * answer.scale)
        biases.append(np.broadcast_to(np.asarray(answer.offset, dtype=np.float64), answer.width))
    slope = next(iter(answer.slopes), 0.0)
    return ReluNetwork(weights, biases, negative_slope=slope, head=found if answer.end else head)


def _head(answer: _Signal) -> Head:
    if answer.end == "ArgMax":
        return Argmax()
    if answer.end in _DECIDED_BY:
        return _DECIDED_BY[answer.end]
    low, high = (np.broadcast_to(limit, answer.width) for limit in (answer.low, answer.high))
    if answer.end == "Clip" and not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InvalidNetworkError(
            f"the answers are clipped to {low.tolist()} .. {high.tolist()}; expected finite limits on both sides"
        )
    if answer.end != "Tanh":
        return Identity().clipped_to(low, high) if answer.end else Identity()
    half, middle = np.asarray(answer.half), np.asarray(answer.middle)
    try:
        return TanhBox(*np.broadcast_arrays(middle - half, middle + half)).clipped_to(low, high)
    except ValueError as error:
        raise InvalidNetworkError(str(error)) from error
