"""ONNX files, read with bounds on their size and nothing outside them; onnx's reference runs the nodes in float64."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.core.smooth_network import Oracle
from otr.errors import ArtefactError, InvalidNetworkError
from otr.importers.assembly import Function, black_box, policy_of
from otr.importers.relu_units import Node
from otr.importers.sections import LIMIT_NUMBERS, MEMORY, Sections

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, NodeProto, TensorProto

_FLOAT, _DOUBLE = 1, 11  # of onnx.TensorProto.DataType
_LIMIT_BYTES = 2**25  # eight million numbers; what a file holds can take eighty times its size in memory
_LEAST_OPSET = 7  # before, operators broadcast by rules of their own
_REMEDY = "export the policy again"
_KINDS: dict[str, Any] = {"tensor(double)": np.float64, "tensor(float16)": np.float16}
_RECURRENT = ("LSTM", "GRU", "RNN")
_REALS = ("FLOAT", "DOUBLE", "FLOAT16", "BFLOAT16")


@dataclass(frozen=True)
class _Graph:
    """What is needed of a graph for one of its outputs.

    Attributes:
        input_name, input_shape: of the states; a size that is not fixed is 0.
        output_name: of the answers.
        nodes: those that the output is computed from, each one after those it reads.
        tensors: the constants by name, not yet unpacked.
        opset: version of the standard operators.
    """

    input_name: str
    input_shape: tuple[int, ...]
    output_name: str
    nodes: list[NodeProto]
    tensors: dict[str, TensorProto]
    opset: int


def sections_of_onnx(given: Any, output: str | None) -> Sections:
    """Return the sections of an ONNX model; `otr.from_onnx` documents what is read, and errors."""
    graph = _read_graph(given, output)
    constants: dict[str, Any] = {}
    nodes = _nodes(graph.nodes, graph.tensors, constants, graph.opset)
    return Sections(graph.input_name, graph.input_shape, nodes, constants, graph.output_name)


def oracle_of_onnx(given: Any, output: str | None) -> Oracle:
    """Return the policy of an ONNX model: its ReLU network, or else what onnxruntime answers."""
    sections = sections_of_onnx(given, output)
    try:
        return policy_of(sections, decides=True)
    except InvalidNetworkError as error:
        content = _content(given)
        return black_box(sections, partial(_runtime, content, sections), str(error), content, ".onnx", output)


def _runtime(content: bytes, sections: Sections, value: str) -> tuple[Function, Function]:
    """Return what onnxruntime makes of a value of the model, for one state and for several.

    Where it cannot load the model, onnx's reference runs the nodes, a state at a time: onnxruntime computes few
    operators in float64.
    """
    import onnxruntime
    from onnx import helper

    model, states = _checked_model(content), sections.input
    graph, nodes = model.graph, _ancestors(model.graph.node, value)
    constants = {tensor.name for tensor in graph.initializer}
    inputs = [each for each in graph.input if each.name == states.name or each.name in constants]
    for kept, wanted in ((graph.node, nodes), (graph.input, inputs), (graph.output, [
        next((each for each in graph.output if each.name == value), helper.make_empty_tensor_value_info(value))
    ])):  # fmt: skip
        copied = [type(each).FromString(each.SerializeToString()) for each in wanted]
        del kept[:]
        kept.extend(copied)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    try:
        session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    except Exception:  # onnxruntime's own errors
        by_reference = partial(sections.answer, value=value)
        return by_reference, lambda X: np.stack([by_reference(x) for x in X])
    declared = next(each for each in session.get_inputs() if each.name == states.name)
    kind = _KINDS.get(declared.type, np.float32)
    is_vector = len(declared.shape) == 1

    def one(state: FloatArray) -> NDArray[Any]:
        return several(state[None])

    def several(X: FloatArray) -> NDArray[Any]:
        given = X[0] if is_vector and len(X) == 1 else X.reshape(-1, *states.shape[1:])
        return np.asarray(session.run([value], {states.name: given.astype(kind)})[0], dtype=np.float64)

    return one, several


def _read_graph(given: Any, output: str | None) -> _Graph:
    """Return what is needed of the model in a file, its bytes or a ModelProto; `otr.from_onnx` documents errors."""
    model = _checked_model(_content(given))
    opset = next((entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")), 0)
    if opset < _LEAST_OPSET:
        raise InvalidNetworkError(f"the model uses opset {opset}, expected {_LEAST_OPSET} or newer; {_REMEDY} with one")
    graph = model.graph
    tensors = {tensor.name: tensor for tensor in graph.initializer}
    output = _one_of([value.name for value in graph.output], output)
    nodes = _ancestors(graph.node, output)
    if nodes and (foreign := [node for node in nodes if node.domain not in ("", "ai.onnx")]):
        raise InvalidNetworkError(
            f"{_describe(foreign[0])} is of the domain {foreign[0].domain!r}, expected ONNX's own operators; {_REMEDY} "
            "without optimisation for one runtime"
        )
    if recurrent := [node for node in nodes if node.op_type in _RECURRENT]:
        raise InvalidNetworkError(MEMORY.format(_describe(recurrent[0])))
    read = {name for node in nodes for name in node.input} | {output}
    inputs = [value for value in graph.input if value.name in read and value.name not in tensors]
    if len(inputs) != 1:
        raise InvalidNetworkError(
            f"{output!r} is computed from {len(inputs)} inputs ({', '.join(v.name for v in inputs[:5]) or 'none'}), "
            "expected one: the states; make constants of the others, such as masks of actions by "
            "model.graph.initializer.append(onnx.numpy_helper.from_array(numpy.ones(shape, 'float32'), name))"
        )
    return _Graph(inputs[0].name, _shape(inputs[0]), output, nodes, tensors, opset)


def _describe(node: NodeProto) -> str:
    """Return how messages name a node."""
    return f"node {node.name or node.output[0]!r} ({node.op_type})"


def _array_of(tensor: TensorProto) -> NDArray[Any]:
    """Return a constant: real numbers as float64, integers and truth values as they are."""
    from onnx import TensorProto, numpy_helper

    kind = TensorProto.DataType.Name(tensor.data_type)
    if kind not in _REALS and not kind.startswith(("INT", "UINT", "BOOL")):
        raise InvalidNetworkError(f"reads the constant {tensor.name!r} of type {kind}, expected real numbers")
    try:
        values = numpy_helper.to_array(tensor)
    except Exception as error:  # a foreign tensor's shape need not fit its numbers
        raise ArtefactError(f"the constant {tensor.name!r} cannot be read ({error}); {_REMEDY}") from error
    return values.astype(np.float64) if kind in _REALS else values


def _content(given: Any) -> bytes:
    """Return the bytes of a model, of no more than `_LIMIT_BYTES`."""
    if isinstance(given, str | os.PathLike):
        path = Path(given)
        try:
            n_bytes = path.stat().st_size
            content = path.read_bytes() if n_bytes <= _LIMIT_BYTES else b""
        except OSError as error:
            raise ArtefactError(f"{path} cannot be read ({error}); give the path of an ONNX file") from error
    else:
        content = given.SerializeToString() if hasattr(given, "SerializeToString") else given
        if not isinstance(content, bytes | bytearray | memoryview):
            raise InvalidNetworkError(f"expected the path of an ONNX file, its bytes or a ModelProto, got {given!r}")
        content = bytes(content)
        n_bytes = len(content)
    if n_bytes > _LIMIT_BYTES:
        raise ArtefactError(f"the model has {n_bytes:,} bytes, the limit is {_LIMIT_BYTES:,}; is it the right file?")
    return content


def _checked_model(content: bytes) -> ModelProto:
    """Return the model, whose graph is in order and keeps all its numbers in the file."""
    import onnx

    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # protobuf's own errors
        raise ArtefactError(f"the model is no ONNX file ({error}); {_REMEDY}") from error
    _refuse_external_data(model.graph.node, model.graph)
    for function in model.functions:
        _refuse_external_data(function.node)
    if any(function.domain in ("", "ai.onnx") for function in model.functions):
        raise InvalidNetworkError(f"the model redefines standard operators, as {model.functions[0].name!r}")
    try:
        onnx.checker.check_model(model)
    except Exception as error:  # the checker's own errors
        raise ArtefactError(f"the model is no valid ONNX model ({str(error).strip()}); {_REMEDY}") from error
    return model


def _refuse_external_data(nodes: Iterable[NodeProto], graph: GraphProto | None = None) -> None:
    """Raise InvalidNetworkError where a tensor's numbers are in another file, which is never opened."""
    from onnx import TensorProto

    tensors, sparse = ([], []) if graph is None else (list(graph.initializer), list(graph.sparse_initializer))
    for node in nodes:
        for attribute in node.attribute:
            tensors += [attribute.t, *attribute.tensors]
            sparse += [attribute.sparse_tensor, *attribute.sparse_tensors]
            for inner in (attribute.g, *attribute.graphs):
                if inner.node or inner.initializer or inner.sparse_initializer:
                    _refuse_external_data(inner.node, inner)
    for tensor in chain(tensors, *((one.values, one.indices) for one in sparse)):
        if tensor.data_location == TensorProto.EXTERNAL or tensor.external_data:
            raise InvalidNetworkError(
                f"the constant {tensor.name!r} is in another file, which is not opened; save the model as one file: "
                "onnx.save(onnx.load(path), path, save_as_external_data=False)"
            )


def _one_of(names: list[str], wanted: str | None) -> str:
    """Return the output that is wanted, or the only one."""
    if wanted is None and len(names) == 1:
        return names[0]
    if wanted not in names:
        problem = "several outputs" if wanted is None else f"no output {wanted!r}"
        raise InvalidNetworkError(f"the model has {problem}; give output= one of {', '.join(map(repr, names[:10]))}")
    return wanted


def _ancestors(nodes: Iterable[NodeProto], output: str) -> list[NodeProto]:
    """Return the nodes that an output is computed from, in the graph's order, which the checker knows to be right."""
    wanted, found = {output}, []
    for node in reversed(list(nodes)):
        if wanted.intersection(node.output):
            found.append(node)
            wanted.update(node.input)
    return found[::-1]


def _shape(value: Any) -> tuple[int, ...]:
    """Return the declared shape of an input; 0 for a size that is not fixed."""
    if not value.type.HasField("tensor_type") or not value.type.tensor_type.HasField("shape"):
        raise InvalidNetworkError(f"the input {value.name!r} has no shape; {_REMEDY} with one, (n, number of inputs)")
    return tuple(int(size.dim_value) for size in value.type.tensor_type.shape.dim)


def _nodes(
    nodes: Iterable[NodeProto], tensors: dict[str, TensorProto], constants: dict[str, Any], opset: int
) -> Iterator[Node]:
    """Yield the nodes in order, with those of the branch that an If of a constant takes in its place."""
    for node in nodes:
        for name in node.input:
            if name in tensors and name not in constants:
                constants[name] = _array_of(tensors[name])
        if node.op_type != "If":
            is_constant = all(name in constants for name in node.input if name)
            yield Node(_describe(node), tuple(node.input), tuple(node.output), _runner(node, opset, is_constant),
                       node.op_type in ("Shape", "Size"))  # fmt: skip
            continue
        if node.input[0] not in constants:
            raise InvalidNetworkError(f"{_describe(node)} chooses by the states; export the policy without branches")
        wanted = "then_branch" if np.all(constants[node.input[0]]) else "else_branch"
        branch = next(attribute.g for attribute in node.attribute if attribute.name == wanted)
        inner = tensors | {tensor.name: tensor for tensor in branch.initializer}
        yield from _nodes(branch.node, inner, constants, opset)
        for made, name in zip(branch.output, node.output, strict=True):
            if made.name in inner and made.name not in constants:
                constants[made.name] = _array_of(inner[made.name])
            yield Node(_describe(node), (made.name,), (name,), lambda operands: operands)


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
            raise InvalidNetworkError(f"{_describe(node)}: the size of its answer is not known before it is computed")
        if math.prod(sizes) > LIMIT_NUMBERS:
            raise InvalidNetworkError(
                f"{_describe(node)} makes {math.prod(sizes):,} numbers of a state, the limit is {LIMIT_NUMBERS:,}"
            )
