"""Networks read from ONNX models: against what a runtime answers, and what is refused."""

import io
import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

import otr
from otr.core.black_box import BlackBox
from otr.importers import read_black_box, read_policy

torch.set_num_threads(1)
RNG = np.random.default_rng(0)
W1, B1 = RNG.normal(size=(4, 3)), RNG.normal(size=4)
W2, B2 = RNG.normal(size=(2, 4)), RNG.normal(size=2)
CONSTANTS = {
    "W1": W1, "W1t": W1.T, "b1": B1, "W2": W2, "W2t": W2.T, "b2": B2[None], "mean": RNG.normal(size=3),
    "scale": RNG.uniform(0.5, 2, size=3), "half": np.array([2.0, 0.5]), "middle": np.array([1.0, -3.0]),
    "low": np.array(-0.5), "high": np.array(0.75), "lows": np.array([-0.5, -1.0]), "highs": np.array([0.75, 0.25]),
    "two": np.array([2.0]), "axes": np.array([1]), "vector": np.array([-1, 3]), "minus": np.array(-1.0),
    "all": np.array([0, -1]), "three axes": np.ones((1, 1, 2)), "yes": np.array(True), "no": np.array(False),
    "huge": np.array([10**9, 1]), "flat": np.array([1, -1]),
    "W": np.ones((1, 8, 3)), "R": np.ones((1, 8, 2)), "slopes": np.array([0.5, -0.25, 1.5, 0.0]),
}  # fmt: skip
HIDDEN = [("Gemm", ["x", "W1", "b1"], "z", {"transB": 1}), ("Relu", ["z"], "a")]
LAST = ("Gemm", ["a", "W2", "b2"], "y", {"transB": 1})


def model(
    *nodes: tuple, shape: tuple = ("n", 3), outputs: tuple = ("y",), opset: int = 17, kind: int = TensorProto.DOUBLE
) -> onnx.ModelProto:
    """Return the model of nodes (operator, inputs, output, attributes), named by their outputs."""
    made = [
        helper.make_node(op, ins, [out], name=f"{out}!", **(rest[0] if rest else {})) for op, ins, out, *rest in nodes
    ]
    used = {name for _, ins, *_ in nodes for name in ins}
    constants = [numpy_helper.from_array(value, name) for name, value in CONSTANTS.items() if name in used]
    is_label = nodes[-1][0] in ("ArgMax", "Cast") or nodes[-1][1] == ["i"]
    answer = ["n"] if is_label else ["n", None]
    graph = helper.make_graph(
        made,
        "policy",
        [helper.make_tensor_value_info("x", kind, shape)],
        [helper.make_tensor_value_info(name, TensorProto.INT64 if is_label else kind, answer) for name in outputs],
        constants,
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)


def answers(made: onnx.ModelProto, X: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(made.SerializeToString())
    given = session.get_inputs()[0]
    X = X.astype(np.float64 if "double" in given.type else np.float32)
    return session.run(None, {given.name: X})[0]


READ = {
    "gemm": [*HIDDEN, LAST],
    "gemm of another size": [("Gemm", ["x", "W1t", "b1"], "z", {"alpha": 0.5, "beta": 2.0}), HIDDEN[1], LAST],
    "matmul and add": [
        ("MatMul", ["x", "W1t"], "u"), ("Add", ["b1", "u"], "z"), HIDDEN[1], ("MatMul", ["a", "W2t"], "v"),
        ("Add", ["v", "b2"], "y"),
    ],
    "normalised states": [("Sub", ["x", "mean"], "u"), ("Div", ["u", "scale"], "v"), ("Gemm", ["v", "W1", "b1"], "z",
                          {"transB": 1}), HIDDEN[1], LAST],
    "shifted and scaled": [("Mul", ["scale", "x"], "u"), ("Sub", ["mean", "u"], "v"), ("Gemm", ["v", "W1", "b1"], "z",
                           {"transB": 1}), HIDDEN[1], LAST],
    "scaled activations": [HIDDEN[0], ("Relu", ["z"], "r"), ("Mul", ["r", "two"], "s"), ("Add", ["s", "b1"], "a"),
                           LAST],
    "turned": [HIDDEN[0], ("Neg", ["z"], "n"), ("Relu", ["n"], "a"), (*LAST[:2], "u", LAST[3]), ("Neg", ["u"], "y")],
    "leaky": [HIDDEN[0], ("LeakyRelu", ["z"], "a", {"alpha": 0.25}), LAST],
    "two layers without activation": [HIDDEN[0], ("Gemm", ["z", "W2", "b2"], "y", {"transB": 1})],
    "ends in relu": [HIDDEN[0], ("Relu", ["z"], "r"), ("Sub", ["r", "two"], "y")],
    "tanh": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Tanh", ["u"], "y")],
    "tanh of a box": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Tanh", ["u"], "t"), ("Mul", ["t", "half"], "s"),
                      ("Add", ["s", "middle"], "y")],
    "tanh within a clip": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Tanh", ["u"], "t"), ("Div", ["t", "two"], "s"),
                           ("Clip", ["s", "low", "high"], "y")],
    "clip": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Clip", ["u", "low", "high"], "y")],
    "clip of each action": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Max", ["u", "lows"], "v"),
                            ("Min", ["highs", "v"], "y")],
    "clip, scaled": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Clip", ["u", "low", "high"], "v"),
                     ("Mul", ["v", "half"], "w"), ("Sub", ["w", "two"], "y")],
    "argmax": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("ArgMax", ["u"], "y", {"axis": 1, "keepdims": 0})],
    "nothing done": [("Flatten", ["x"], "f"), ("Reshape", ["f", "vector"], "g"), ("Identity", ["g"], "h"),
                     ("Reshape", ["h", "all"], "i"), ("Cast", ["i"], "j", {"to": TensorProto.DOUBLE}),
                     ("Dropout", ["j", "", "no"], "k"), ("Gemm", ["k", "W1", "b1"], "z", {"transB": 1}), HIDDEN[1],
                     LAST],
    "tanh, turned": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Tanh", ["u"], "t"), ("Mul", ["t", "minus"], "y")],
    "clip units": [HIDDEN[0], ("Clip", ["z", "low", "high"], "a"), LAST],
    "clip on one side": [HIDDEN[0], ("Clip", ["z", "", "high"], "a"), (*LAST[:2], "u", LAST[3]),
                         ("Clip", ["u", "low"], "y")],
    "clip of one answer": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Clip", ["u", "high", "low"], "v"),
                           ("Add", ["v", "u"], "y")],
    "abs": [HIDDEN[0], ("Abs", ["z"], "a"), LAST],
    "max and min": [HIDDEN[0], ("Max", ["z", "b1"], "c"), ("Min", ["high", "c"], "a"), LAST],
    "prelu": [HIDDEN[0], ("PRelu", ["z", "slopes"], "a"), LAST],
    "two slopes": [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("LeakyRelu", ["u"], "y")],
    "relu of the states": [("Relu", ["x"], "a"), ("MatMul", ["a", "W1t"], "y")],
    "no layer": [("Add", ["x", "mean"], "y")],
    "residual": [*HIDDEN, ("Gemm", ["x", "W1"], "s", {"transB": 1}), ("Add", ["a", "s"], "r"), ("Relu", ["r"], "q"),
                 ("Add", ["q", "a"], "p"), ("Gemm", ["p", "W2", "b2"], "y", {"transB": 1})],
    "constants as nodes": [("Transpose", ["W1"], "t"), ("Constant", [], "b", {"value": numpy_helper.from_array(B1)}),
                           ("MatMul", ["x", "t"], "u"), ("Add", ["u", "b"], "z"), HIDDEN[1], LAST],
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_answers_are_the_runtimes(name):
    made = model(*READ[name])
    X = RNG.normal(size=(500, 3)) * 2
    network = otr.from_onnx(made)
    np.testing.assert_allclose(network.predict(X), answers(made, X).reshape(network.predict(X).shape), atol=1e-12)
    if network.n_hidden:  # the graph is not a constant, and its tree is the same function
        np.testing.assert_allclose(otr.map_network(network).predict(X), network.predict(X), rtol=0, atol=1e-12)
        assert len(np.unique(network.predict(X), axis=0)) > 1


MODULES = {
    "tanh": lambda: nn.Sequential(nn.Linear(6, 5), nn.ReLU(), nn.Linear(5, 3), nn.ReLU(), nn.Linear(3, 2), nn.Tanh()),
    "leaky": lambda: nn.Sequential(nn.Linear(6, 5, bias=False), nn.LeakyReLU(0.1), nn.Linear(5, 1)),
    "flat": lambda: nn.Sequential(nn.Flatten(), nn.Linear(6, 5), nn.ReLU(), nn.Linear(5, 3), nn.Hardtanh(-1.5, 0.5)),
}


@pytest.mark.parametrize("name", MODULES)
def test_what_torch_exports(tmp_path: Path, name: str) -> None:
    torch.manual_seed(0)
    module, file = MODULES[name](), io.BytesIO()
    shape = (1, 2, 3) if name == "flat" else (1, 6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(module, (torch.zeros(shape),), file, dynamo=False, dynamic_axes={"x": [0]}, input_names=["x"])
    (tmp_path / "policy.onnx").write_bytes(file.getvalue())
    X = RNG.normal(size=(200, 6)).astype(np.float32)
    expected = answers(onnx.load_model_from_string(file.getvalue()), X.reshape(-1, *shape[1:]))
    for given in (tmp_path / "policy.onnx", str(tmp_path / "policy.onnx"), file.getvalue()):
        np.testing.assert_allclose(otr.from_onnx(given).predict(X), expected, atol=2e-6)


def test_probabilities_need_their_head():
    nodes = [*HIDDEN, (*LAST[:2], "u", LAST[3]), ("Softmax", ["u"], "y")]
    with pytest.raises(otr.InvalidNetworkError, match=r"ends in Softmax; it needs head=otr.Argmax\(\)"):
        otr.from_onnx(model(*nodes))
    X = RNG.normal(size=(100, 3))
    labels = otr.from_onnx(model(*nodes), head=otr.Argmax()).predict(X)
    np.testing.assert_array_equal(labels, answers(model(*nodes), X).argmax(axis=1))


def one_more(*nodes: tuple) -> list[tuple]:
    return [*HIDDEN, (*LAST[:2], "u", LAST[3]), *nodes]


OTHER_UNITS = {
    "tanh": ([("Tanh", ["z"], "a")], np.tanh),
    "silu": ([("Sigmoid", ["z"], "s"), ("Mul", ["z", "s"], "a")], lambda z: z / (1 + np.exp(-z))),
    "layer norm": ([("LayerNormalization", ["z", "b1"], "a")],
                   lambda z: (z - z.mean(1, keepdims=True)) / np.sqrt(z.var(1, keepdims=True) + 1e-5) * B1),
    "elu": ([("Elu", ["z"], "a")], lambda z: np.where(z > 0, z, np.expm1(np.minimum(z, 0)))),  # by the reference alone
}  # fmt: skip


@pytest.mark.parametrize("name", OTHER_UNITS)
@pytest.mark.parametrize("end", ["", "Softmax", "ArgMax"])
def test_any_units_are_an_oracle(name: str, end: str) -> None:
    units, function = OTHER_UNITS[name]
    last = [(*LAST[:2], "u", LAST[3]), (end, ["u"], "y", {"axis": 1})] if end else [LAST]
    last = [*last[:-1], (*last[-1][:3], {"axis": 1, "keepdims": 0})] if end == "ArgMax" else last
    made = model(HIDDEN[0], *units, *last)
    oracle, X = read_policy(made), RNG.normal(size=(100, 3))
    assert isinstance(oracle, BlackBox) and "is not affine, and no unit of a ReLU network" in oracle.reason
    expected = function(X @ W1.T + B1) @ W2.T + B2
    np.testing.assert_allclose(oracle.forward(X), expected, atol=1e-6)
    np.testing.assert_array_equal(oracle.first_layer, np.column_stack((W1, B1)))
    assert oracle.head == (otr.Argmax() if end else otr.Identity())
    with pytest.raises(otr.InvalidNetworkError, match=r"let a tree imitate the model as it is: otr.imitate\("):
        otr.from_onnx(made)
    again = read_black_box(oracle.content, oracle.suffix, oracle.output)
    np.testing.assert_array_equal(again.predict(X), oracle.predict(X))
    assert again.digest == oracle.digest != oracle.replace(clip=1.0).digest


def test_a_model_of_one_state_alone_answers_several() -> None:
    made = model(HIDDEN[0], ("Tanh", ["z"], "a"), LAST, ("Reshape", ["y", "flat"], "w"), shape=(1, 3), outputs=("w",))
    X = RNG.normal(size=(20, 3))
    np.testing.assert_allclose(read_policy(made).predict(X), np.tanh(X @ W1.T + B1) @ W2.T + B2, atol=1e-12)


def test_masks_are_made_constants_as_the_message_says() -> None:
    """As of ML-Agents, whose actions may be masked."""
    made = model(HIDDEN[0], ("Tanh", ["z"], "a"), (*LAST[:2], "u", LAST[3]), ("Mul", ["u", "masks"], "y"))
    made.graph.input.append(helper.make_tensor_value_info("masks", TensorProto.DOUBLE, (1, 2)))
    with pytest.raises(otr.InvalidNetworkError, match=r"from 2 inputs \(x, masks\), .*initializer.append\("):
        read_policy(made)
    made.graph.initializer.append(numpy_helper.from_array(np.array([[1.0, 0.0]]), "masks"))
    X = RNG.normal(size=(20, 3))
    np.testing.assert_allclose(read_policy(made).predict(X), (np.tanh(X @ W1.T + B1) @ W2.T + B2) * [1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([("Unsqueeze", ["x", "axes"], "s"), ("LSTM", ["s", "W", "R"], "y", {"hidden_size": 2})], "remembers earlier"),
        ([HIDDEN[0], ("RandomNormalLike", ["z"], "r"), ("Tanh", ["r"], "y")], "answers differently every time"),
        (one_more(("Tanh", ["u"], "t"), ("ArgMax", ["t"], "i", {"axis": 1}), ("Neg", ["i"], "y")), "more than a shape"),
        (one_more(("Tanh", ["u"], "t"), ("Cast", ["t"], "y", {"to": TensorProto.INT64})), "whole numbers that are no"),
        ([("Expand", ["x", "huge"], "t"), ("Exp", ["t"], "y")], "makes 3,000,000,000 numbers of a state"),
    ],
)
def test_what_is_no_oracle(nodes: list, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        read_policy(model(*nodes))


def test_one_of_several_outputs():
    nodes = [*HIDDEN, LAST, ("Gemm", ["x", "W1", "b1"], "value", {"transB": 1}), ("Exp", ["value"], "exp")]
    made = model(*nodes, outputs=("y", "value", "exp"))
    with pytest.raises(otr.InvalidNetworkError, match="several outputs; give output= one of 'y', 'value', 'exp'"):
        otr.from_onnx(made)
    with pytest.raises(otr.InvalidNetworkError, match="no output 'actions'"):
        otr.from_onnx(made, output="actions")
    assert otr.from_onnx(made, output="y").n_outputs == 2
    assert otr.from_onnx(made, output="value").n_outputs == 4


@pytest.mark.parametrize(
    ("nodes", "options", "message"),
    [
        (one_more(("Tanh", ["u"], "t"), ("Clip", ["t", "low", "high"], "y")), {}, "the answers go through tanh to"),
        (one_more(("Div", ["two", "u"], "y")), {}, r"node 'y!' \(Div\) is not affine"),
        (one_more(("Add", ["u", "b1"], "y")), {}, r"'y!' \(Add\) cannot be run on the shapes \[\(1, 2\), \(4,\)\]"),
        (
            one_more(("Add", ["u", "three axes"], "v"), ("ArgMax", ["v"], "y", {"axis": 1})),
            {},
            r"\(ArgMax\) is not affine, .* sees the numbers of one state",
        ),
        (one_more(("ArgMax", ["u"], "y", {"axis": 0})), {}, r"\(ArgMax\) is not affine, .* of one state"),
        (one_more(("Softmax", ["u"], "y", {"axis": 0})), {}, r"\(Softmax\) goes over the states"),
        (one_more(("ArgMax", ["u"], "y", {"axis": 1, "select_last_index": 1})), {}, r"\(ArgMax\) is not affine"),
        ([("Cast", ["x"], "f", {"to": TensorProto.INT64}), ("MatMul", ["f", "W1t"], "y")], {}, r"'f!' \(Cast\) is not"),
        ([("RandomNormalLike", ["x"], "f"), ("Add", ["f", "x"], "y")], {}, r"\(RandomNormalLike\) answers differently"),
        ([("Expand", ["x", "huge"], "y")], {}, r"'y!' \(Expand\) makes 3,000,000,000 numbers of a state"),
        ([("MatMul", ["x", "W1t"], "y")], {"shape": ("n", "d")}, r"has the shape \(\?, \?\)"),
        ([("MatMul", ["x", "W1t"], "y")], {"opset": 6}, "opset 6, expected 7 or newer"),
    ],
)
def test_what_is_refused(nodes, options, message):
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.from_onnx(model(*nodes, **options))


def test_foreign_operators_and_functions_are_refused():
    made = model(*READ["gemm"])
    made.graph.node[1].domain = "com.example"
    made.opset_import.append(helper.make_opsetid("com.example", 1))
    with pytest.raises(otr.InvalidNetworkError, match=r"'a!' \(Relu\) is of the domain 'com.example'"):
        otr.from_onnx(made)
    made = model(*READ["gemm"])
    body = [helper.make_node("Neg", ["X"], ["Y"])]
    made.functions.append(helper.make_function("", "Relu", ["X"], ["Y"], body, [helper.make_opsetid("", 17)]))
    with pytest.raises(otr.InvalidNetworkError, match="redefines standard operators"):
        otr.from_onnx(made)


def test_no_other_file_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    onnx.save(model(*READ["gemm"]), path, save_as_external_data=True, location="numbers", size_threshold=0)
    with pytest.raises(otr.InvalidNetworkError, match="'W1' is in another file, which is not opened"):
        otr.from_onnx(path)
    (tmp_path / "numbers").unlink()
    with pytest.raises(otr.InvalidNetworkError, match="is in another file"):
        otr.from_onnx(path)


def test_small_files_of_large_matrices_are_refused():
    """Two thin matrices, the product of which is far larger than the file."""
    n = 2**18
    weights = {"wide": np.zeros((1, n), np.float16), "tall": np.zeros((n, 1), np.float16)}
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "tall"], ["u"]), helper.make_node("MatMul", ["u", "wide"], ["y"])],
        "policy",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT16, ["n", n])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT16, ["n", n])],
        [numpy_helper.from_array(array, name) for name, array in weights.items()],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    with pytest.raises(otr.InvalidNetworkError, match="makes a matrix of 262144 x 262144 numbers"):
        otr.from_onnx(made)


@pytest.mark.parametrize("given", [b"", b"PK\x03\x04 no model", bytes(2**25 + 1)], ids=["empty", "other", "large"])
def test_what_is_no_model(tmp_path: Path, given: bytes) -> None:
    (tmp_path / "policy.onnx").write_bytes(given)
    for source in (given, tmp_path / "policy.onnx"):
        with pytest.raises(otr.ArtefactError, match=r"is no (valid )?ONNX|limit is 33,554,432"):
            otr.from_onnx(source)


def test_every_cut_off_file_is_an_error_of_ours():
    content = model(*READ["tanh"]).SerializeToString()
    for length in range(0, len(content), 7):
        with pytest.raises(otr.OtrError):
            otr.from_onnx(content[:length])


def test_shapes_that_do_not_fit_their_numbers():
    made = model(*READ["gemm"])
    made.graph.initializer[0].dims[:] = [2**31, 2**31]
    with pytest.raises(otr.OtrError, match="W1"):
        otr.from_onnx(made)


def test_other_things_are_named():
    with pytest.raises(otr.InvalidNetworkError, match="the path of an ONNX file, its bytes or a ModelProto, got 3"):
        otr.from_onnx(3)
    with pytest.raises(otr.ArtefactError, match=r"nowhere.onnx cannot be read"):
        otr.from_onnx("nowhere.onnx")
