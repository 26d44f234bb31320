import json
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

import otr
from tests.core.strategies import Case, assert_same_answers, cases, make_network
from tests.programs.policies import assert_answers, chain, committed, policies, states_for

POLICIES = policies()


def run(model: onnx.ModelProto, states: NDArray) -> NDArray:
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (answers,) = session.run(None, {"x": states})
    return np.asarray(answers)


@pytest.mark.parametrize("name", POLICIES)
def test_every_policy(name: str) -> None:
    tree = POLICIES[name]
    assert_answers(tree, states_for(tree), run(otr.to_onnx(tree), states_for(tree)))


@given(cases(max_layers=3))
@settings(max_examples=25)
def test_equals_the_network(case: Case) -> None:
    answers = run(otr.to_onnx(otr.map_network(case.network)), case.states)
    assert_same_answers(answers, case.network.predict(case.states), case.network, case)


@pytest.mark.parametrize("name", POLICIES)
def test_every_constant_is_read(name: str) -> None:
    graph = otr.to_onnx(POLICIES[name]).graph
    bodies = [attribute.g for node in graph.node for attribute in node.attribute]
    read = {name for each in (graph, *bodies) for node in each.node for name in node.input}
    assert {constant.name for constant in graph.initializer} <= read


@pytest.mark.parametrize("n_states", [0, 1, 7])
def test_any_number_of_states(n_states: int) -> None:
    states = np.random.default_rng(0).normal(size=(n_states, 11))
    assert run(otr.to_onnx(committed("hopper")), states).shape == (n_states, 3)


@pytest.mark.parametrize(("depth", "operator"), [(64, "Where"), (65, "Loop"), (1500, "Loop")])
def test_deep_trees_walk_in_a_loop(depth: int, operator: str) -> None:
    tree = chain(depth)
    model = otr.to_onnx(tree)
    assert operator in {node.op_type for node in model.graph.node}
    states = np.array([[depth - 0.5, 0.0], [depth + 0.5, 0.0], [0.0, 0.0], [3.0, 1.0]])
    assert_answers(tree, states, run(model, states))


def test_float() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(0), (4,), n_outputs=2, head="tanh_box"))
    states = states_for(tree).astype(np.float32)
    answers = run(otr.to_onnx(tree, dtype="float"), states)
    assert answers.dtype == np.float32
    np.testing.assert_allclose(answers, tree.predict(states), atol=1e-5)


def test_what_a_reader_of_the_model_sees() -> None:
    model = otr.to_onnx(committed("lander"), feature_names=list("abcdefgh"), output_names=list("wxyz"))
    assert model.opset_import[0].version == 17
    assert [output.name for output in model.graph.output] == ["label"]
    metadata = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    assert metadata == {"features": list("abcdefgh"), "outputs": list("wxyz"), "head": {"name": "argmax"}}
    assert otr.to_onnx(committed("lander")).SerializeToString() == otr.to_onnx(committed("lander")).SerializeToString()


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="dtype is 'half', expected 'double' or 'float'"):
        otr.to_onnx(POLICIES["worked"], dtype="half")  # type: ignore[arg-type]
    huge = otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[1e300]]], [[0.0]])
    with pytest.raises(ValueError, match="1e\\+300, too large for a float"):
        otr.to_onnx(huge, dtype="float")
    tiny = otr.ObliqueTree([-1], [-2], [[1e-50]], [0.0], np.zeros((2, 1, 1)), [[-1.0], [1.0]])
    with pytest.raises(ValueError, match="largest weight is 1e-50, too small for a float"):
        otr.to_onnx(tiny, dtype="float")


def test_without_onnx_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r"pip install 'otr\[onnx\]'"):
        otr.to_onnx(POLICIES["worked"])
