import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

import otr
from tests.core.strategies import Case, assert_same_answers, cases
from tests.programs.policies import COMMITTED, assert_answers, chain, committed, policies, states_for

POLICIES = policies()
# Stands for a machine without numpy: no site-packages, nothing from the environment.
BARE = [sys.executable, "-I", "-S"]
RUNNER = """
import json, sys
assert not any("site-packages" in path for path in sys.path)
for line in open(sys.argv[1]):
    job = json.loads(line)
    scope = {}
    exec(compile(job["program"], "policy", "exec"), scope)
    print(json.dumps([scope["policy"](state) for state in job["states"]]))
assert "numpy" not in sys.modules
"""


def function(program: str, name: str = "policy") -> Callable[[Any], Any]:
    scope: dict[str, Any] = {}
    exec(compile(program, "policy", "exec"), scope)
    answer: Callable[[Any], Any] = scope[name]
    return answer


def test_every_policy_in_a_bare_interpreter(tmp_path) -> None:
    trees = {**POLICIES, "stairs_of_300": chain(300), **{name: committed(name) for name in COMMITTED}}
    states = {name: states_for(tree, 10_000 if name in COMMITTED else 400) for name, tree in trees.items()}
    jobs = [json.dumps({"program": otr.to_python(tree), "states": states[name].tolist()})
            for name, tree in trees.items()]  # fmt: skip
    (tmp_path / "jobs").write_text("\n".join(jobs))
    done = subprocess.run([*BARE, "-c", RUNNER, str(tmp_path / "jobs")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for (name, tree), line in zip(trees.items(), done.stdout.splitlines(), strict=True):
        assert_answers(tree, states[name], json.loads(line))


@given(cases())
@settings(max_examples=40)
def test_equals_the_network(case: Case) -> None:
    answer = function(otr.to_python(otr.map_network(case.network)))
    answers = np.array([answer(state) for state in case.states.tolist()])
    assert_same_answers(answers, case.network.predict(case.states), case.network, case)


def test_the_text_of_a_small_policy() -> None:
    tree = otr.ObliqueTree([~0], [~1], [[-3.8, 114.3]], [-2.2], [[[0.0, 0.0]], [[-169.8, 5116.5]]], [[-6.1], [-102.3]],
                           head=otr.ClipBox(-1, 1))  # fmt: skip
    assert otr.to_python(tree, feature_names=["x", "the speed"], output_names=["if"]) == (
        "# An oblique decision tree of depth 1 with 2 leaves.\n"
        "# It needs nothing but the standard library.\n"
        "#\n"
        "# state[0]: x\n"
        '# state[1]: the_speed ("the speed")\n'
        '# The answer is the list of: if_2 ("if")\n'
        "\n"
        "\n"
        "def policy(state):\n"
        "    x, the_speed = map(float, state)\n"
        "    if -2.2 - 3.8 * x + 114.3 * the_speed <= 0:\n"
        "        if_2 = -6.1\n"
        "    else:\n"
        "        if_2 = -102.3 - 169.8 * x + 5116.5 * the_speed\n"
        "    return [min(max(if_2, -1.0), 1.0)]\n"
    )


def test_labels_carry_their_names() -> None:
    program = otr.to_python(committed("lander"), output_names=["coast", "left", "main\nengine", "right"])
    assert "return 2  # main engine\n" in program


@pytest.mark.parametrize("max_nested_depth", [64, 0], ids=["nested", "tables"])
def test_numbers_of_float32_are_computed_with_in_float64(monkeypatch, max_nested_depth: int) -> None:
    """In float32 the input is 0.1 and goes left; it is a little more."""
    monkeypatch.setattr("otr.programs.python.MAX_NESTED_DEPTH", max_nested_depth)
    tree = otr.ObliqueTree([~0], [~1], [[1.0, 0.0]], [-0.1], [[[0.0, 0.0]], [[0.3, 1.0]]], [[0.0], [1.0]])
    state = np.array([0.1, 0.7], np.float32)
    (answer,) = function(otr.to_python(tree))(state)
    assert type(answer) is float and answer == pytest.approx(tree.predict(state)[0], rel=1e-15)


@pytest.mark.parametrize("max_nested_depth", [64, 0], ids=["nested", "tables"])
def test_a_count_that_no_float_holds_is_infinite(monkeypatch, max_nested_depth: int) -> None:
    monkeypatch.setattr("otr.programs.python.MAX_NESTED_DEPTH", max_nested_depth)
    tree = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], [[[0.0]], [[1.0]]], [[2.0], [0.0]], head=otr.Exp())
    answer = function(otr.to_python(tree))
    largest = np.log(np.finfo(np.float64).max)
    states = np.array([[-1.0], [1.0], [largest], [np.nextafter(largest, np.inf)], [800.0]])
    np.testing.assert_allclose([answer(state) for state in states.tolist()], tree.predict(states), rtol=1e-12)
    assert answer([800.0]) == [np.inf]


@pytest.mark.parametrize(("depth", "nested"), [(64, True), (65, False), (3000, False)])
def test_deep_trees_become_tables(depth: int, nested: bool) -> None:
    tree = chain(depth)
    program = otr.to_python(tree)
    assert ("else:" in program) == nested
    states = np.array([[depth - 0.5, 0.0], [depth + 0.5, 0.0], [0.0, 0.0], [-1.0, 1.0]])
    assert_answers(tree, states, list(map(function(program), states.tolist())))


def test_thousands_of_inputs() -> None:
    rng = np.random.default_rng(0)
    tree = otr.ObliqueTree([~0], [~1], rng.normal(size=(1, 2048)), [0.0], rng.normal(size=(2, 1, 2048)), [[0.0], [1.0]])
    states = rng.normal(size=(20, 2048))
    assert_answers(tree, states, list(map(function(otr.to_python(tree)), states.tolist())))


@pytest.mark.parametrize("name", ["9lives", "class", "max", "float", "a b", ""])
def test_a_bad_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="cannot be the name"):
        otr.to_python(POLICIES["worked"], name=name)
