"""A tree as an ONNX model of standard operators; needs the package onnx, which is loaded when a model is made."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import singledispatch
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.extras import naming_the_extra
from otr.programs.names import check_tree, give_labels, names_of, one_line
from otr.programs.walk import child, distinct_rows, require_float_rows, summary_of

if TYPE_CHECKING:
    from onnx import ModelProto, NodeProto

OPSET, IR_VERSION = 17, 8  # runtimes from 2022 on read these
# A tree deeper than this walks in a Loop; others level by level, which more converters to small devices know.
MAX_UNROLLED_DEPTH = 64


@naming_the_extra("otr.to_onnx")
def to_onnx(
    tree: ObliqueTree,
    *,
    name: str = "policy",
    dtype: Literal["double", "float"] = "double",
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> ModelProto:
    """Return an ONNX model (opset 17) that answers as ``tree.predict`` does, on any number of states at once.

    Its input ``x`` is (n, d); its output is ``y``, (n, o), or ``label``, (n,) int64. Every state carries the number of
    its node, and each level of the tree gathers the row of that test; the names are in the model's metadata.

    Args:
        tree: any tree.
        name: of the graph.
        dtype: "double" or "float", of the input and of all arithmetic.
        feature_names, output_names: as in `to_text`.

    Raises:
        MissingExtraError: onnx is not installed.
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, names that are not distinct, a `name` that is no line of text, another
            `dtype`, or a number that is too large for a float, or too small in a test.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> otr.to_onnx(tree).graph.name
        'policy'
    """
    check_tree(tree)
    features, answers = names_of(tree, feature_names, output_names)
    if not name or name != one_line(name):
        raise ValueError(f"name is {name!r}, expected one line of characters that print, as the name of the graph")
    if dtype not in ("double", "float"):
        raise ValueError(f"dtype is {dtype!r}, expected 'double' or 'float'")
    if dtype == "float":
        require_float_rows(tree.test_forms[:, :-1])
    from onnx import TensorProto, checker, helper

    graph = _Graph(np.float64 if dtype == "double" else np.float32)
    answer = _answer(graph, tree, _find_leaf(graph, tree))
    kind = TensorProto.DOUBLE if dtype == "double" else TensorProto.FLOAT
    is_label = give_labels(tree)
    output = "label" if is_label else "y"
    graph.add("Identity", [answer], output)
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            name,
            [helper.make_tensor_value_info("x", kind, ["n", tree.n_inputs])],
            [helper.make_tensor_value_info(output, *(_label_info() if is_label else (kind, ["n", len(answers)])))],
            graph.constants_read(),
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="otr",
        doc_string=f"{name}: {summary_of(tree)}",
    )
    metadata = {"features": features, "outputs": answers, "head": tree.head.to_dict()}
    helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    checker.check_model(model, full_check=True)
    return model


def _label_info() -> tuple[int, list[str]]:
    from onnx import TensorProto

    return TensorProto.INT64, ["n"]


class _Graph:
    """Nodes and constants as they are added; every result has a name of its own."""

    def __init__(self, real: type[np.floating[Any]], prefix: str = "") -> None:
        self.nodes: list[NodeProto] = []
        self.constants: list[Any] = []
        self.real = real
        self.prefix = prefix

    def add(self, operator: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:
        """Add a node and return the name of its output."""
        from onnx import helper

        output = output or f"{self.prefix}{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def constant(self, name: str, values: NDArray[Any]) -> str:
        """Add a constant, real numbers in the graph's type, and return its name."""
        from onnx import numpy_helper

        array = np.asarray(values, order="C")
        if array.dtype.kind == "f":
            with np.errstate(over="ignore"):
                array = array.astype(self.real)
            if not np.isfinite(array).all():
                largest = float(np.abs(values).max())
                raise ValueError(
                    f"the policy holds the number {largest:.6g}, too large for a float; use dtype='double'"
                )
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def constants_read(self) -> list[Any]:
        """Return the constants that some node reads, in a loop's body or outside; a runtime warns of others."""
        bodies = [attribute.g.node for node in self.nodes for attribute in node.attribute]
        read = {name for nodes in (self.nodes, *bodies) for node in nodes for name in node.input}
        return [constant for constant in self.constants if constant.name in read]


def _find_leaf(graph: _Graph, tree: ObliqueTree) -> str:
    """Return the name of each state's leaf, (n,) int64.

    Nodes are numbered as in the tree, leaf k is node n_nodes + k; a leaf's test has the weights of node 0 and both its
    children are itself, so that a state that has arrived stays.
    """
    n_nodes, n_leaves = tree.n_nodes, tree.n_leaves
    graph.constant("axis_1", np.array([1], dtype=np.int64))
    graph.constant("zero", np.zeros(1))
    n_states = graph.add("Shape", ["x"], start=0, end=1)
    node = graph.add("Expand", [graph.constant("root", np.zeros(1, dtype=np.int64)), n_states])
    if not n_nodes:
        return node
    tests, test_of = distinct_rows(tree.test_forms)
    references = child(tree)
    children = np.where(references >= 0, references, n_nodes + ~references)
    arrived = np.arange(n_nodes, n_nodes + n_leaves)
    graph.constant("weights", tests[:, :-1])
    graph.constant("offsets", tests[:, -1])
    graph.constant("test_of", np.concatenate((test_of, np.zeros(n_leaves, dtype=np.int64))))
    graph.constant("left", np.concatenate((children[:, 0], arrived)))
    graph.constant("right", np.concatenate((children[:, 1], arrived)))
    if tree.depth <= MAX_UNROLLED_DEPTH:
        for _ in range(tree.depth):
            node = _step(graph, node)
    else:
        node = _loop(graph, node, tree.depth)
    return graph.add("Sub", [node, graph.constant("first_leaf", np.array([n_nodes], dtype=np.int64))])


def _step(graph: _Graph, node: str, output: str = "") -> str:
    """Go from each state's node to its child."""
    test = graph.add("Gather", ["test_of", node])
    terms = graph.add("Mul", [graph.add("Gather", ["weights", test]), "x"])
    total = graph.add("ReduceSum", [terms, "axis_1"], keepdims=0)
    z = graph.add("Add", [total, graph.add("Gather", ["offsets", test])])
    right = graph.add("Greater", [z, "zero"])
    children = graph.add("Gather", ["right", node]), graph.add("Gather", ["left", node])
    return graph.add("Where", [right, *children], output)


def _loop(graph: _Graph, node: str, depth: int) -> str:
    """Take `depth` steps in a Loop, whose body reads the tables outside."""
    from onnx import TensorProto, helper

    body = _Graph(graph.real, prefix="loop_")
    _step(body, "loop_node", "loop_child")
    body.add("Identity", ["loop_go_on"], "loop_still")
    inputs = [
        helper.make_tensor_value_info("loop_number", TensorProto.INT64, []),
        helper.make_tensor_value_info("loop_go_on", TensorProto.BOOL, []),
        helper.make_tensor_value_info("loop_node", TensorProto.INT64, ["n"]),
    ]
    outputs = [
        helper.make_tensor_value_info("loop_still", TensorProto.BOOL, []),
        helper.make_tensor_value_info("loop_child", TensorProto.INT64, ["n"]),
    ]
    steps = graph.constant("depth", np.array(depth, dtype=np.int64))
    go_on = graph.constant("go_on", np.array(True))
    return graph.add("Loop", [steps, go_on, node], body=helper.make_graph(body.nodes, "level", inputs, outputs))


def _answer(graph: _Graph, tree: ObliqueTree, leaf: str) -> str:
    """Return the name of the answers."""
    if tree.labels is not None:
        return graph.add("Gather", [graph.constant("labels", tree.labels), leaf])
    maps = graph.add("Gather", [graph.constant("leaf_weights", tree.M), leaf])
    column = graph.constant("axis_2", np.array([2], dtype=np.int64))
    products = graph.add("MatMul", [maps, graph.add("Unsqueeze", ["x", column])])
    offsets = graph.add("Gather", [graph.constant("leaf_offsets", tree.c), leaf])
    y = graph.add("Add", [graph.add("Squeeze", [products, column]), offsets])
    return answer_node(tree.head, graph, y, tree.n_outputs)


@singledispatch
def answer_node(head: Head, graph: _Graph, y: str, n_outputs: int) -> str:
    """Return the name of the answers under a head, given that of the outputs (n, n_outputs)."""
    raise no_entry(head, "to_onnx")


@answer_node.register
def _(head: Identity, graph: _Graph, y: str, n_outputs: int) -> str:
    return y


@answer_node.register
def _(head: Exp, graph: _Graph, y: str, n_outputs: int) -> str:
    return graph.add("Exp", [y])


@answer_node.register
def _(head: ClipBox, graph: _Graph, y: str, n_outputs: int) -> str:
    low, high = head.limits(n_outputs)
    return graph.add("Min", [graph.add("Max", [y, graph.constant("low", low)]), graph.constant("high", high)])


@answer_node.register
def _(head: TanhBox, graph: _Graph, y: str, n_outputs: int) -> str:
    return _squashed(head, graph, y, n_outputs)


@answer_node.register
def _(head: PidBox, graph: _Graph, y: str, n_outputs: int) -> str:
    n_actions = len(head.low)
    shape = np.array([-1, 1 + n_actions, head.n_terms(n_outputs)])
    vectors = graph.add("Reshape", [y, graph.constant("vectors", shape)])
    terms = graph.add("Gather", [vectors, graph.constant("of_terms", np.array([0]))], axis=1)
    gains = graph.add("Gather", [vectors, graph.constant("of_gains", np.arange(1, 1 + n_actions))], axis=1)
    controls = graph.add("ReduceSum", [graph.add("Mul", [gains, terms]), "axis_2"], keepdims=0)
    return _squashed(head, graph, controls, n_outputs)


@answer_node.register
def _(head: Sign, graph: _Graph, y: str, n_outputs: int) -> str:
    from onnx import TensorProto

    above = graph.add("Greater", [graph.add("Squeeze", [y, "axis_1"]), "zero"])
    return graph.add("Cast", [above], to=TensorProto.INT64)


@answer_node.register
def _(head: Argmax, graph: _Graph, y: str, n_outputs: int) -> str:
    return graph.add("ArgMax", [y], axis=1, keepdims=0)


def _squashed(head: TanhBox | PidBox, graph: _Graph, controls: str, n_outputs: int) -> str:
    half, middle = head.halves_and_middles(n_outputs)
    scaled = graph.add("Mul", [graph.add("Tanh", [controls]), graph.constant("half", half)])
    return graph.add("Add", [scaled, graph.constant("middle", middle)])
