"""The nodes of an ONNX graph, each of which onnx's reference runs in float64."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.errors import InvalidNetworkError
from otr.importers.onnx_file import array_of, describe, read_graph
from otr.importers.sections import LIMIT_NUMBERS, Node, Sections

if TYPE_CHECKING:
    from onnx import NodeProto, TensorProto

_FLOAT, _DOUBLE = 1, 11  # of onnx.TensorProto.DataType


def sections_of_onnx(given: Any, output: str | None) -> Sections:
    """Return the sections of an ONNX model; `otr.from_onnx` documents what is read, and errors."""
    graph = read_graph(given, output)
    constants: dict[str, Any] = {}
    nodes = _nodes(graph.nodes, graph.tensors, constants, graph.opset)
    return Sections(graph.input_name, graph.input_shape, nodes, constants, graph.output_name)


def _nodes(
    nodes: Iterable[NodeProto], tensors: dict[str, TensorProto], constants: dict[str, Any], opset: int
) -> Iterator[Node]:
    """Yield the nodes in order, with those of the branch that an If of a constant takes in its place."""
    for node in nodes:
        for name in node.input:
            if name in tensors and name not in constants:
                constants[name] = array_of(tensors[name])
        if node.op_type != "If":
            is_constant = all(name in constants for name in node.input if name)
            yield Node(describe(node), tuple(node.input), tuple(node.output), _runner(node, opset, is_constant),
                       node.op_type in ("Shape", "Size"))  # fmt: skip
            continue
        if node.input[0] not in constants:
            raise InvalidNetworkError(f"{describe(node)} chooses by the states; export the policy without branches")
        wanted = "then_branch" if np.all(constants[node.input[0]]) else "else_branch"
        branch = next(attribute.g for attribute in node.attribute if attribute.name == wanted)
        inner = tensors | {tensor.name: tensor for tensor in branch.initializer}
        yield from _nodes(branch.node, inner, constants, opset)
        for made, name in zip(branch.output, node.output, strict=True):
            if made.name in inner and made.name not in constants:
                constants[made.name] = array_of(inner[made.name])
            yield Node(describe(node), (made.name,), (name,), lambda operands: operands)


def _runner(node: NodeProto, opset: int, is_constant: bool) -> Callable[[list[Any]], Sequence[Any]]:
    """Return what runs a node: reals are float64 throughout, and float32 where constants are cast to it."""
    to = next((attribute.i for attribute in node.attribute if attribute.name == "to"), 0)
    if node.op_type == "Cast" and to in (_FLOAT, _DOUBLE):
        kind = np.float32 if is_constant and to == _FLOAT else np.float64
        return lambda operands: [np.asarray(operands[0]).astype(kind).astype(np.float64)]
    operators: list[Any] = []

    def run(operands: list[Any]) -> Sequence[Any]:
        if not operators:
            _require_moderate(node, operands, opset)
            operators.append(_operator(node, opset))
        made = operators[0].run(*operands)
        return [np.asarray(each, np.float64) if _is_real(each) else np.asarray(each) for each in made]

    return run


def _is_real(value: Any) -> bool:
    return np.asarray(value).dtype.kind == "f"


def _operator(node: NodeProto, opset: int) -> Any:
    from onnx import helper
    from onnx.reference import ReferenceEvaluator

    inputs = [helper.make_empty_tensor_value_info(name) for name in dict.fromkeys(node.input) if name]
    outputs = [helper.make_empty_tensor_value_info(name) for name in node.output if name]
    graph = helper.make_graph([node], "one", inputs, outputs)
    return ReferenceEvaluator(graph, opsets={"": opset}).rt_nodes_[0]


def _require_moderate(node: NodeProto, operands: list[Any], opset: int) -> None:
    """Raise InvalidNetworkError where the answer is too large, or its size is not known, before it is computed."""
    from onnx import helper, numpy_helper, shape_inference

    given: dict[str, NDArray[Any]] = {
        name: np.asarray(value) for name, value in zip(node.input, operands, strict=True) if name
    }
    infos = [
        helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(value.dtype), value.shape)
        for name, value in given.items()
    ]
    small = [numpy_helper.from_array(value, name) for name, value in given.items() if value.size <= 64]
    outputs = [helper.make_empty_tensor_value_info(name) for name in node.output if name]
    model = helper.make_model(
        helper.make_graph([node], "one", infos, outputs, small), opset_imports=[helper.make_opsetid("", opset)]
    )
    inferred = shape_inference.infer_shapes(model, strict_mode=True, data_prop=True).graph.output
    for value in inferred:
        kind = value.type.tensor_type
        sizes = [size.dim_value if size.HasField("dim_value") else -1 for size in kind.shape.dim]
        if not kind.HasField("shape") or min(sizes, default=0) < 0:
            raise InvalidNetworkError(f"{describe(node)}: the size of its answer is not known before it is computed")
        if math.prod(sizes) > LIMIT_NUMBERS:
            raise InvalidNetworkError(
                f"{describe(node)} makes {math.prod(sizes):,} numbers of a state, the limit is {LIMIT_NUMBERS:,}"
            )
