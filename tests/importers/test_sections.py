"""Sections of a model between its activations: read from what they evaluate to, bit for bit, or refused by name."""

import io
import warnings
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator
from torch import nn

import otr
from otr.core.black_box import BlackBox
from otr.importers.assembly import policy_of
from otr.importers.sections import Sections

torch.set_num_threads(1)
RNG = np.random.default_rng(0)
W1, B1, W2, B2 = RNG.normal(size=(6, 4)), RNG.normal(size=6), RNG.normal(size=(2, 6)), RNG.normal(size=2)
LAYERS = [("Gemm", ["c", "W1", "b1"], "z", {"transB": 1}), ("Relu", ["z"], "a"), ("Gemm", ["a", "W2", "b2"], "u",
          {"transB": 1})]  # fmt: skip
INTEGERS = {"zero": 0, "axis": [0], "minus": [-1], "five": [5], "flat": [1, -1], "image": [1, 4, 1, 1], "two": [2]}


def model(nodes: list, shape: tuple = ("n", 4), *, label: bool = False, **constants: np.ndarray) -> onnx.ModelProto:
    """Return the model of nodes (operator, inputs, output, attributes), whose last output is the answer."""
    numbers = {"W1": W1, "b1": B1, "W2": W2, "b2": B2, **constants}
    numbers |= {name: np.array(value, dtype=np.int64) for name, value in INTEGERS.items()}
    steps = [helper.make_node(op, ins, out.split(), **(rest[0] if rest else {})) for op, ins, out, *rest in nodes]
    kind = TensorProto.INT64 if label else TensorProto.DOUBLE
    graph = helper.make_graph(
        steps,
        "policy",
        [helper.make_tensor_value_info("x", TensorProto.DOUBLE, shape)],
        [helper.make_empty_tensor_value_info(nodes[-1][2])],
        [numpy_helper.from_array(value, name) for name, value in numbers.items()],
    )
    graph.output[0].type.tensor_type.elem_type = kind
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    inferred = onnx.shape_inference.infer_shapes(made, data_prop=True)
    if not inferred.graph.output[0].type.tensor_type.HasField("shape"):
        inferred.graph.output[0].type.tensor_type.shape.dim.add()
    return inferred


def assert_read(made: onnx.ModelProto, shape: tuple = (1, 4)) -> otr.ReluNetwork:
    """Compare the network, and its tree, with what the runtime answers."""
    network, session = otr.from_onnx(made), ReferenceEvaluator(made)
    with suppress(onnxruntime.capi.onnxruntime_pybind11_state.NotImplemented):  # convolutions in float64
        session = onnxruntime.InferenceSession(made.SerializeToString())
    X = RNG.normal(size=(60, network.n_inputs)) * 2
    expected = np.array([session.run(None, {"x": x.reshape(shape)})[0].ravel() for x in X])
    for policy in (network, otr.map_network(network)):
        found = policy.predict(X)
        np.testing.assert_allclose(found, expected.reshape(found.shape), rtol=0, atol=1e-12)
    return network


def branch(name: str, operator: str) -> onnx.GraphProto:
    node = helper.make_node(operator, ["x"], [f"{name} out"])
    return helper.make_graph([node], name, [], [helper.make_empty_tensor_value_info(f"{name} out")])


BEFORE = {
    "concat of one": [("Flatten", ["x"], "f"), ("Concat", ["f"], "c", {"axis": 1})],
    "shape and gather": [("Shape", ["x"], "s"), ("Gather", ["s", "zero"], "n"), ("Unsqueeze", ["n", "axis"], "m"),
                         ("Concat", ["m", "minus"], "t", {"axis": 0}), ("Reshape", ["x", "t"], "c")],
    "batch norm": [("BatchNormalization", ["x", "gain", "shift", "mean", "variance"], "c")],
    "split and concat": [("Split", ["x", "parts"], "p q", {"axis": 1}), ("Concat", ["q", "p"], "c", {"axis": 1})],
    "a branch of constants": [("Shape", ["x"], "s"), ("Size", ["s"], "k"), ("Equal", ["k", "two"], "is_two"),
                              ("If", ["is_two"], "c", {"then_branch": branch("then", "Identity"),
                                                       "else_branch": branch("else", "Exp")})],
    "convolution": [("Reshape", ["x", "image"], "i"), ("Conv", ["i", "kernel"], "k"), ("Reshape", ["k", "flat"], "c")],
    "what nothing reads": [("Exp", ["x"], "e"), ("Sqrt", ["b1"], "r"), ("Identity", ["x"], "c")],
}  # fmt: skip


@pytest.mark.parametrize("name", BEFORE)
def test_whatever_is_affine(name: str) -> None:
    constants = {
        "gain": RNG.normal(size=4), "shift": RNG.normal(size=4), "mean": RNG.normal(size=4),
        "variance": RNG.uniform(0.5, 2, size=4), "parts": np.array([1, 3]), "kernel": RNG.normal(size=(4, 4, 1, 1)),
    }  # fmt: skip
    assert assert_read(model([*BEFORE[name], *LAYERS], **constants)).hidden_widths == (6,)


@pytest.mark.parametrize("shape", [(4,), (1, 1, 1, 4), (1, 4, 1), (1, 4)])
def test_shapes_of_states(shape: tuple) -> None:
    assert_read(model([("Reshape", ["x", "flat"], "c"), *LAYERS], shape), shape)


ENDS = {
    "log sum exp": [("ReduceLogSumExp", ["u"], "l", {"axes": [1]}), ("Sub", ["u", "l"], "v")],
    "softmax": [("Softmax", ["u"], "v", {"axis": -1})],
    "logarithm of softmax": [("Softmax", ["u"], "p", {"axis": -1}), ("LogSoftmax", ["u"], "v")],
}


@pytest.mark.parametrize("name", ENDS)
@pytest.mark.parametrize("after", [[], [("Reshape", ["i", "minus"], "r"), ("Cast", ["r"], "y", {"to": 7})]])
def test_labels(name: str, after: list) -> None:
    nodes = [("Identity", ["x"], "c"), *LAYERS, *ENDS[name], ("ArgMax", ["v"], "i", {"axis": 1, "keepdims": 0}), *after]
    network = assert_read(model(nodes, label=True))
    assert network.head == otr.Argmax() and network.hidden_widths == (6,)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([("Floor", ["x"], "c")], r"node 'c' \(Floor\) is not affine"),
        ([("Exp", ["x"], "e"), ("Sin", ["x"], "s"), ("Add", ["e", "s"], "c")], r"\(Exp\), node 's' \(Sin\) are not"),
        ([("Less", ["x", "gain"], "l"), ("Exp", ["x"], "e"), ("Where", ["l", "x", "e"], "c")], r"'l' \(Less\) is not"),
        ([("Less", ["x", "gain"], "l"), ("Not", ["l"], "n"), ("Cast", ["n"], "c", {"to": 11})], r"'l' \(Less\) is not"),
        ([("NonZero", ["x"], "k"), ("Cast", ["k"], "c", {"to": 11})], "its answer is not known before"),
    ],
)
def test_what_is_not_affine_is_named(nodes: list, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.from_onnx(model([*nodes, *LAYERS], gain=np.full(4, 1e12)))


def test_a_wide_layer_is_read_in_few_evaluations() -> None:
    """Its matrix is a constant that the section reads; what only evaluates to a matrix takes many basis at a time."""
    rng, n_calls = np.random.default_rng(0), 0

    def times(W: np.ndarray) -> Callable:
        def step(x: np.ndarray) -> np.ndarray:
            nonlocal n_calls
            n_calls += 1
            return x @ W.T

        return step

    W, V = rng.standard_normal((300, 4)), rng.standard_normal((2, 300))
    steps = [("wide", times(W)), ("units", lambda z: np.maximum(z, 0)), ("last", times(V))]
    for matrices, most in (({0: W, 2: V}, 100), ({2: W}, 110)):
        n_calls = 0
        network = policy_of(Sections.of_steps(steps, 4, matrices), answer=lambda x: V @ np.maximum(W @ x, 0))
        assert n_calls < most
        np.testing.assert_array_equal(network.weights[0], W)
        np.testing.assert_array_equal(network.weights[1], V)


@pytest.mark.parametrize("limits", [["", "far"], ["low", "far"]])
def test_a_clip_far_away_is_no_section(limits: list) -> None:
    clip = ("Clip", ["x", *limits], "c")
    network = otr.from_onnx(model([clip, *LAYERS], low=np.array(-1e9), far=np.array(1e9)))
    far = np.array([[3e9, 0, 0, 0]])
    np.testing.assert_allclose(network.predict(far), network.predict(far / 3), rtol=1e-9)


CLIPS = [(-2.0, 2.0), (-50.0, 50.0), (0.0, 6.0), (0.0, np.inf), (3.0, 4.0), (-1e-3, 1e-3)]


@pytest.mark.parametrize("limits", CLIPS)
def test_a_clip_of_one_number_is_read_whatever_its_weights(limits: tuple) -> None:
    """The points on which it is tried must not be on one side of it."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        W, b = rng.uniform(-1, 1, size=(1, 3)), rng.uniform(-1, 1, size=1)
        steps = [("layer", lambda x, W=W, b=b: x @ W.T + b), ("clip", lambda z: np.clip(z, *limits))]
        network = policy_of(Sections.of_steps(steps, 3, {0: W}))
        X = rng.normal(size=(200, 3)) * 10.0 ** rng.integers(-4, 4, size=(200, 1))
        np.testing.assert_allclose(network.predict(X), np.clip(X @ W.T + b, *limits), rtol=0, atol=1e-9)


def test_what_is_linear_along_each_line_through_zero_is_no_section() -> None:
    for seed in range(20):
        W = np.random.default_rng(seed).normal(size=(3, 4))
        steps = [("layer", lambda x, W=W: x @ W.T), ("median", lambda z: np.median(z, axis=-1, keepdims=True))]
        with pytest.raises(otr.InvalidNetworkError, match="median is not affine"):
            policy_of(Sections.of_steps(steps, 4, {0: W}))


CHOSEN = {
    "where": [("Greater", ["z", "low"], "g"), ("Where", ["g", "z", "low"], "a")],
    "where not": [("Greater", ["z", "low"], "g"), ("Not", ["g"], "n"), ("Where", ["n", "low", "z"], "a")],
    "times a comparison": [("Greater", ["z", "low"], "g"), ("Cast", ["g"], "t", {"to": 11}), ("Mul", ["z", "t"], "a")],
}


@pytest.mark.parametrize("name", CHOSEN)
def test_relu_written_with_a_comparison(name: str) -> None:
    """Also where it is the policy's answer."""
    layers = [("Gemm", ["x", "W1", "b1"], "z", {"transB": 1}), *CHOSEN[name]]
    assert assert_read(model([*layers, LAYERS[2]], low=np.zeros(1))).hidden_widths == (6,)
    assert assert_read(model(layers, low=np.zeros(1))).hidden_widths == (6,)


def with_numbers(name: str, value: float) -> onnx.ModelProto:
    numbers = {"W2": W2.copy(), "b2": B2.copy(), "offset": np.zeros(4)}
    numbers[name].flat[0] = value
    return model([("Add", ["x", "offset"], "c"), *LAYERS], **numbers)


@pytest.mark.parametrize(
    ("name", "value"), [("W2", np.nan), ("W2", np.inf), ("W2", -np.inf), ("b2", np.inf), ("offset", np.nan)]
)
def test_weights_that_are_not_finite(name: str, value: float) -> None:
    for read in (otr.from_onnx, otr.read_policy):
        with pytest.raises(
            otr.InvalidNetworkError, match=f"node '[uc]' .* reads '{name}': a weight or bias is not fin"
        ):
            read(with_numbers(name, value))


def test_infinite_limits_and_masks_are_none_of_weights() -> None:
    limits = {"low": np.array(-np.inf), "far": np.array(np.inf)}
    assert_read(model([("Clip", ["x", "low", "far"], "c"), *LAYERS], **limits))
    mask = np.array([0, 0, -np.inf, 0])
    masked = [("Add", ["x", "mask"], "m"), ("Softmax", ["m"], "c"), *LAYERS]
    assert isinstance(otr.read_policy(model(masked, mask=mask)), BlackBox)
    with pytest.raises(otr.InvalidNetworkError, match=r"the model answers \[.*-inf.*\] in the state"):
        otr.read_policy(with_numbers("b2", -np.inf))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(-60, 40), st.integers(-60, 40))
def test_stored_numbers_are_read_bit_for_bit(seed: int, size: int, size_b: int) -> None:
    """Weights of any size beside biases of any other."""
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((6, 4)) * 2.0 ** rng.integers(size, size + 20, size=(6, 4)) * (rng.random((6, 4)) < 0.7)
    b = rng.standard_normal(6) * 2.0**size_b
    nodes = [("MatMul", ["x", "V"], "m"), ("Add", ["m", "b"], "z"), ("Relu", ["z"], "a"),
             ("Gemm", ["a", "W2", "b2"], "y", {"transB": 1})]  # fmt: skip
    network = otr.from_onnx(model(nodes, V=W.T.copy(), b=b))
    for found, stored in zip((*network.weights, *network.biases), (W, W2, b, B2), strict=True):
        np.testing.assert_array_equal(found, stored)


class Residual(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.one, self.norm, self.two, self.last = nn.Linear(4, 5), nn.BatchNorm1d(5), nn.Linear(5, 5), nn.Linear(5, 2)
        self.norm.running_mean.normal_()
        self.norm.running_var.uniform_(0.5, 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        a = torch.relu_(self.norm(self.one(x.reshape(x.shape[0], -1))))
        b = a + torch.nn.functional.leaky_relu(self.two(a), 0.1)
        left, right = b.chunk(2, dim=1)
        return self.last(torch.cat((left, right), dim=1).abs()).clamp_(-0.5, 0.75)


def test_modules_exports_and_onnx_of_one_model_are_one_network() -> None:
    module, file = Residual().double().eval(), io.BytesIO()
    X = torch.from_numpy(RNG.normal(size=(60, 4)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(module, (X[:1],))
        torch.onnx.export(module, (X[:1],), file, dynamo=False, input_names=["x"])
    expected = module(X).detach().numpy()
    for network, rounding in (
        (otr.from_torch(module), 1e-12), (otr.from_torch(program), 1e-12),
        (otr.from_onnx(file.getvalue()), 1e-8),  # its slope is a float32
    ):  # fmt: skip
        assert network.hidden_widths == (5, 10, 10) and network.head == otr.ClipBox([-0.5] * 2, [0.75] * 2)
        np.testing.assert_allclose(network.predict(X.numpy()), expected, rtol=0, atol=rounding)
