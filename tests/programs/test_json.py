import json
import math
from typing import Any

import numpy as np
import pytest

import otr
from tests.programs.policies import assert_answers, committed, policies, states_for

POLICIES = policies()


def answer(program: dict[str, Any], x: list[float]) -> Any:
    """Execute a program as to_json's docstring says, knowing nothing else of it."""

    def affine(weights: list[float], offset: float) -> float:
        return sum(w * value for w, value in zip(weights, x, strict=True)) + offset

    r = program["root"]
    while r >= 0:
        node = program["nodes"][r]
        r = node["left"] if affine(node["weights"], node["offset"]) <= 0 else node["right"]
    leaf = program["leaves"][-1 - r]
    if "label" in leaf:
        return leaf["label"]
    y = [affine(weights, offset) for weights, offset in zip(leaf["weights"], leaf["offsets"], strict=True)]
    head = program["head"]
    if head["name"] == "sign":
        return 1 if y[0] > 0 else 0
    if head["name"] == "argmax":
        return y.index(max(y))
    if head["name"] == "identity":
        return y
    if head["name"] == "exp":
        return [math.exp(value) if value < 709 else math.inf for value in y]
    if head["name"] == "pid_box":
        m = len(y) // (1 + len(head["low"]))
        terms, *gains = (y[i : i + m] for i in range(0, len(y), m))
        y = [sum(gain * term for gain, term in zip(own, terms, strict=True)) for own in gains]
    lows, highs = (limit if isinstance(limit, list) else [limit] * len(y) for limit in (head["low"], head["high"]))
    if head["name"] == "clip_box":
        return [min(max(value, low), high) for value, low, high in zip(y, lows, highs, strict=True)]
    assert head["name"] in ("tanh_box", "pid_box")
    return [low + (math.tanh(v) + 1) / 2 * (high - low) for v, low, high in zip(y, lows, highs, strict=True)]


@pytest.mark.parametrize("name", POLICIES)
def test_every_policy(name: str) -> None:
    tree = POLICIES[name]
    program = json.loads(otr.to_json(tree))
    states = states_for(tree, 300)
    answers = [answer(program, state) for state in states.tolist()]
    assert program["answer"] == ("label" if isinstance(answers[0], int) else "values")
    assert_answers(tree, states, answers)


def test_nothing_is_lost() -> None:
    tree = committed("lander")
    names = ["x", 'the "y"', "ü"] + [f"s{i}" for i in range(5)]
    program = json.loads(otr.to_json(tree, feature_names=names, output_names=["a", "b", "c", "d"]))
    assert program["schema"] == "otr/program/1"
    assert (program["features"], program["outputs"]) == (names, ["a", "b", "c", "d"])
    nodes, leaves = program["nodes"], program["leaves"]
    again = otr.ObliqueTree(
        [node["left"] for node in nodes],
        [node["right"] for node in nodes],
        [node["weights"] for node in nodes],
        [node["offset"] for node in nodes],
        [leaf["weights"] for leaf in leaves],
        [leaf["offsets"] for leaf in leaves],
        labels=[leaf["label"] for leaf in leaves],
        head=otr.head_from_dict(program["head"]),
    )
    for array in ("children_left", "children_right", "P", "v", "M", "c", "labels"):
        np.testing.assert_array_equal(getattr(again, array), getattr(tree, array))
    assert again.head == tree.head
