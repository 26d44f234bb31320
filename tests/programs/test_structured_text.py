import re

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import otr
from otr.control import pid_network
from otr.programs import structured_text
from otr.programs.structured_text import number
from tests.programs.controller import FunctionBlock
from tests.programs.policies import assert_answers, chain, policies, states_for, without_labels

# blark's parser (Earley) takes a second for two kilobytes, so the trees are small.
SMALL = ("worked", "wide_tanh", "labels", "one_label", "mixed", "sparse", "pid", "pid_of_two_actions")
POLICIES = {
    **{name: tree for name, tree in policies().items() if name in SMALL or name.endswith("of_one_leaf")},
    "argmax": chain(2, otr.Argmax()),
    "one_gain": otr.map_network(
        pid_network(otr.ReluNetwork([[[1.0]], [[2.0], [0.0], [0.0]]], [[-0.5], [0.25, 0.0, -1.0]]), [-2.0], [2.0])
    ),
    "clip": chain(3, otr.ClipBox([-5.0, -2.0], [2.0, 0.0])),
    "sign": without_labels(otr.ObliqueTree([~0], [~1], [[1.0, 2.0]], [0.5], [[[1.0, 0.0]], [[0.0, -1.0]]],
                                           [[1.0], [0.0]]), otr.Sign()),
}  # fmt: skip


def answers_of(tree: otr.ObliqueTree, states: np.ndarray) -> list:
    """Return what a tree's function block answers: its outputs in order, or its label."""
    block = FunctionBlock(otr.to_structured_text(tree))
    found = [block(*state) for state in states.tolist()]
    if block.outputs == ["label"]:
        return [answer["label"] for answer in found]
    return [list(answer.values()) for answer in found]


@pytest.mark.parametrize("name", POLICIES)
def test_every_policy(name: str) -> None:
    tree = POLICIES[name]
    states = states_for(tree, 60)
    assert_answers(tree, states, answers_of(tree, states))


@pytest.mark.parametrize("name", ["wide_tanh", "labels", "argmax", "clip", "sign", "one_gain"])
def test_every_policy_as_tables(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structured_text, "MAX_NESTED_DEPTH", 0)
    tree = POLICIES[name]
    assert "WHILE" in otr.to_structured_text(tree)
    states = states_for(tree, 60)
    assert_answers(tree, states, answers_of(tree, states))


@pytest.mark.parametrize(("depth", "nested"), [(64, True), (65, False), (5000, False)])
def test_deep_trees_become_tables(depth: int, nested: bool) -> None:
    text = otr.to_structured_text(chain(depth))
    assert (text.count("END_IF;") == depth) == nested
    assert (f"child : ARRAY [0..{2 * depth - 1}] OF DINT" in text) != nested


@given(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False))
@example(5e-324)
@example(-0.0)
def test_literals_are_real_and_lose_nothing(value: float) -> None:
    text = number(value)
    assert re.fullmatch(r"-?\d+\.\d+(E[+-]?\d+)?", text)
    assert float(text) == value


def test_the_text_of_a_small_policy() -> None:
    tree = otr.ObliqueTree([~0], [~1], [[-3.8, 1e-7]], [-2.2], [[[0.0, 0.0]], [[-169.8, 5116.5]]], [[-6.1], [-102.3]],
                           head=otr.TanhBox(0, 4))  # fmt: skip
    text = otr.to_structured_text(tree, name="Car", feature_names=["Exit", "a  (*b*)"], output_names=["exit"])
    assert text == (
        "(* Car: an oblique decision tree of depth 1 with 2 leaves. *)\n"
        "FUNCTION_BLOCK Car\n"
        "VAR_INPUT\n"
        "    Exit_2 : LREAL; (* Exit *)\n"
        "    a_b : LREAL; (* a ( *b* ) *)\n"
        "END_VAR\n"
        "VAR_OUTPUT\n"
        "    exit_3 : LREAL; (* exit *)\n"
        "END_VAR\n"
        "VAR\n"
        "    decay : LREAL;\n"
        "END_VAR\n"
        "\n"
        "IF -2.2 - 3.8 * Exit_2 + 1.0E-7 * a_b <= 0.0 THEN\n"
        "    exit_3 := -6.1;\n"
        "ELSE\n"
        "    exit_3 := -102.3 - 169.8 * Exit_2 + 5116.5 * a_b;\n"
        "END_IF;\n"
        "(* tanh(u) = (1 - decay) / (1 + decay) with the sign of u, where decay = exp(-2 |u|). *)\n"
        "decay := EXP(-2.0 * ABS(exit_3));\n"
        "IF exit_3 < 0.0 THEN\n"
        "    exit_3 := 2.0 + 2.0 * (decay - 1.0) / (1.0 + decay);\n"
        "ELSE\n"
        "    exit_3 := 2.0 + 2.0 * (1.0 - decay) / (1.0 + decay);\n"
        "END_IF;\n"
        "END_FUNCTION_BLOCK\n"
    )
    np.testing.assert_allclose(FunctionBlock(text)(0.5, 3.0)["exit_3"], tree.predict([0.5, 3.0]), rtol=1e-12)


@pytest.mark.parametrize("name", ["9", "If", "a__b", "a_", "limit", ""])
def test_a_bad_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="cannot be the name of a function block"):
        otr.to_structured_text(POLICIES["worked"], name=name)
