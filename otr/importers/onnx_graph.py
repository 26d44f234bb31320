"""A network from an ONNX graph, node by node: each is a step of a chain of layers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.errors import InvalidNetworkError
from otr.importers.chain import Chain, naming
from otr.importers.onnx_file import Graph, array_of, attributes, describe, numbers, read_graph

if TYPE_CHECKING:
    from collections.abc import Callable

    from onnx import NodeProto

_ACCEPTED = (
    "accepted are Gemm, MatMul, Add, Sub, Mul and Div with constants, Neg, Relu, LeakyRelu, at the end Tanh, Clip, Max "
    "and Min with constants or ArgMax, and Flatten, Reshape, Identity, Cast and Dropout that change no number"
)
_FLOAT, _INT32, _INT64, _DOUBLE = 1, 6, 7, 11  # of onnx.TensorProto.DataType


def chain_of_onnx(given: Any, output: str | None) -> Chain:
    """Return the layers of an ONNX model; `otr.from_onnx` documents what is read, and errors."""
    graph = read_graph(given, output)
    values: dict[str, Chain | NDArray[Any]] = {graph.input_name: Chain(_input_shape(graph)[1:])}
    for node in graph.nodes:
        with naming(describe(node)):
            operands: list[Any] = []
            for name in node.input:
                if name and name not in values:
                    if name not in graph.tensors:
                        raise InvalidNetworkError(f"reads {name!r}, which is no value; {_ACCEPTED}")
                    values[name] = array_of(graph.tensors[name])
                operands.append(values[name] if name else None)
            values[node.output[0]] = _result(node, operands, graph)
    answer = values.get(graph.output_name)
    if not isinstance(answer, Chain):
        raise InvalidNetworkError(f"{graph.output_name!r} is not computed from {graph.input_name!r}")
    return answer


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
    """Return what a node makes of constants, or of the chain and constants."""
    chains = [operand for operand in operands if isinstance(operand, Chain)]
    if not chains:
        return _constant(node, operands)
    if len(chains) > 1:
        raise InvalidNetworkError("joins two values that depend on the states; only a chain of layers can be read")
    if node.op_type in ("Identity", "Cast", "Dropout", "Flatten", "Reshape"):
        return _passed_on(node, chains[0], operands, graph.input_shape[0])
    handler = _HANDLERS.get(node.op_type)
    if handler is None:
        raise InvalidNetworkError(f"cannot be read; {_ACCEPTED}")
    return handler(node, chains[0], operands, graph.opset)


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
    raise InvalidNetworkError("of constants cannot be read; export the policy with constants folded")


def _passed_on(node: NodeProto, chain: Chain, operands: list[Any], n_states: int) -> Chain:
    """Return the chain after a node that changes no number, or raise InvalidNetworkError."""
    given, shape = attributes(node), chain.shape
    is_same = True
    if node.op_type == "Flatten":
        is_same = given.get("axis", 1) % (1 + len(shape)) == 1
        shape = (chain.width,)
    elif node.op_type == "Reshape":
        wanted = operands[1].tolist() if isinstance(operands[1], np.ndarray) else []
        is_same = len(wanted) == 2 and not given.get("allowzero", 0)
        is_same = is_same and (wanted[0] in (0, n_states) or (wanted[0] in (-1, 1) and wanted[1] == chain.width))
        is_same = is_same and wanted[1] in (-1, chain.width)
        shape = (chain.width,)
    elif node.op_type == "Cast":
        is_same = given["to"] in ((_INT32, _INT64) if chain.end == "ArgMax" else (_FLOAT, _DOUBLE))
    elif node.op_type == "Dropout":
        is_same = len(operands) < 3 or operands[2] is None or np.array_equal(operands[2], False)  # not training
    if not is_same:
        raise InvalidNetworkError(f"changes more than the shape of each state; {_ACCEPTED}")
    return chain.reshaped(shape)


def _gemm(node: NodeProto, chain: Chain, operands: list[Any], opset: int) -> Chain:
    given = attributes(node)
    _require_rows(chain, operands, given.get("transA", 0))
    W = given.get("alpha", 1.0) * numbers(operands[1])
    made = chain.linear(W if given.get("transB", 0) else W.T)
    if len(operands) < 3 or operands[2] is None:
        return made
    return made.affine(1.0, given.get("beta", 1.0) * numbers(operands[2]))


def _matmul(node: NodeProto, chain: Chain, operands: list[Any], opset: int) -> Chain:
    _require_rows(chain, operands)
    return chain.linear(numbers(operands[1]).T)


def _require_rows(chain: Chain, operands: list[Any], is_transposed: int = 0) -> None:
    if operands[0] is not chain or is_transposed:
        raise InvalidNetworkError("multiplies from the left; expected states in rows as its input A")


def _arithmetic(node: NodeProto, chain: Chain, operands: list[Any], opset: int) -> Chain:
    """Add, Sub, Mul or Div of the chain and a constant."""
    is_first = operands[0] is chain
    constant = numbers(operands[1 if is_first else 0])
    return chain.arithmetic(node.op_type.lower(), constant, constant_first=not is_first)


def _leaky_relu(node: NodeProto, chain: Chain, operands: list[Any], opset: int) -> Chain:
    return chain.activation(float(np.float32(attributes(node).get("alpha", 0.01))))


def _smooth(node: NodeProto, chain: Chain, operands: list[Any], opset: int) -> Chain:
    given = attributes(node)
    if given.get("alpha", 1.0) != 1.0 or given.get("approximate", b"none") != b"none":
        raise InvalidNetworkError("has another alpha than 1, or is approximated, which cannot be read")
    return chain.activation(node.op_type.lower())


def _clip(node: NodeProto, chain: Chain, operands: list[Any], opset: int) -> Chain:
    """Clip, or a Max or Min with a constant."""
    if node.op_type in ("Max", "Min"):
        if len(operands) != 2:
            raise InvalidNetworkError(f"compares {len(operands)} values, expected one and a constant")
        limit = numbers(operands[1 if operands[0] is chain else 0])
        return chain.clip(limit, None) if node.op_type == "Max" else chain.clip(None, limit)
    if opset < 11:
        given = attributes(node)
        return chain.clip(given.get("min", -math.inf), given.get("max", math.inf))
    limits = [None if value is None else numbers(value) for value in operands[1:]]
    return chain.clip(*limits, *[None] * (2 - len(limits)))


def _decision(node: NodeProto, chain: Chain, operands: list[Any], opset: int) -> Chain:
    """ArgMax, or a Softmax before which a head answers the same."""
    given = attributes(node)
    axis = given.get("axis", 0 if node.op_type == "ArgMax" else -1 if opset >= 13 else 1)
    if given.get("select_last_index", 0):
        raise InvalidNetworkError("takes the last of equal outputs, expected each state's first largest output")
    return chain.decision(node.op_type, {1: 0, -1: -1}.get(axis))


_HANDLERS: dict[str, Callable[[NodeProto, Chain, list[Any], int], Chain]] = {
    "Gemm": _gemm,
    "MatMul": _matmul,
    **dict.fromkeys(("Add", "Sub", "Mul", "Div"), _arithmetic),
    "Neg": lambda node, chain, operands, opset: chain.affine(-1.0, 0.0),
    "Relu": lambda node, chain, operands, opset: chain.activation(0.0),
    "LeakyRelu": _leaky_relu,
    **dict.fromkeys(("Tanh", "Sigmoid", "Elu", "Gelu", "Softplus", "Softsign", "Mish", "HardSwish"), _smooth),
    **dict.fromkeys(("Clip", "Max", "Min"), _clip),
    **dict.fromkeys(("ArgMax", "Softmax", "LogSoftmax"), _decision),
}
