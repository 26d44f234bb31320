"""Programs mean as trees what they say: against Python itself, and against the trees that to_text wrote them from."""

from __future__ import annotations

import functools
import textwrap
import tracemalloc

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import otr
from tests.core.strategies import Case, assert_same_answers, cases, make_network

NAMES = ["x", "y", "z"]
GRID = np.stack(np.meshgrid(*[np.arange(-1.5, 2.0, 0.5)] * 3), axis=-1).reshape(-1, 3)  # hits many boundaries


def parse(text: str, **options: object) -> otr.ObliqueTree:
    return otr.parse_program(textwrap.dedent(text), NAMES, **options)  # type: ignore[arg-type]


def names_for(tree: otr.ObliqueTree) -> list[str]:
    return [f"x{i}" for i in range(tree.n_inputs)]


@settings(max_examples=60)
@given(cases(max_layers=3))
def test_what_to_text_writes_is_read_back(case: Case) -> None:
    tree = otr.map_network(case.network)
    has_labels = tree.labels is not None
    text = otr.to_text(tree, precision=17)
    parsed = otr.parse_program(text, names_for(tree), labels=has_labels)
    assert parsed.n_leaves <= tree.n_leaves
    assert_same_answers(parsed.predict(case.states), tree.predict(case.states), case.network, case)
    # Tests are left out once: what is left is written and read back to the same text.
    again = otr.to_text(parsed, precision=17)
    assert otr.to_text(otr.parse_program(again, names_for(tree), labels=has_labels), precision=17) == again


@pytest.mark.parametrize("head", ["identity", "exp", "tanh_box", "clip_box"])
def test_every_number_comes_back_to_the_last_bit(head: str) -> None:
    tree = otr.map_network(make_network(np.random.default_rng(3), (4,), n_outputs=2, head=head))
    text = otr.to_text(tree, precision=17)
    parsed = otr.parse_program(text, names_for(tree))
    assert (otr.to_text(parsed, precision=17), parsed.head) == (text, tree.head)


@pytest.mark.parametrize("head", [otr.Sign(), otr.Argmax()])
def test_heads_that_answer_labels_without_labels_in_the_leaves(head: otr.Head) -> None:
    rng = np.random.default_rng(0)
    n_outputs = 1 if isinstance(head, otr.Sign) else 3
    M, c = rng.integers(-2, 3, (2, n_outputs, 3)), rng.integers(-1, 2, (2, n_outputs))
    tree = otr.ObliqueTree([~0], [~1], [[1.0, -1.0, 0.0]], [0.5], M, c, head=head)
    parsed = otr.parse_program(otr.to_text(tree), ["x0", "x1", "x2"], labels=True)
    np.testing.assert_array_equal(parsed.predict(GRID), tree.predict(GRID))
    assert len(np.unique(tree.predict(GRID))) == max(2, n_outputs)


@functools.cache
def expressions(depth: int) -> st.SearchStrategy[str]:
    """Affine expressions over the inputs, u and w in Python's own syntax; dyadic numbers, so nothing is rounded."""
    numbers = st.sampled_from(["0", "1", "2", "0.5", "3", "1.5"])
    leaves = st.one_of(numbers, st.sampled_from([*NAMES, "u", "w"]))
    if depth == 0:
        return leaves
    deeper = expressions(depth - 1)
    conditional = st.builds("({} if {} else {})".format, deeper, conditions(depth - 1), deeper)
    return st.one_of(
        leaves,
        st.builds("{} {} {}".format, deeper, st.sampled_from("+-"), deeper),
        st.builds("({}) * {}".format, deeper, numbers),
        st.builds("-({}) / {}".format, deeper, st.sampled_from(["2", "-4"])),
        st.builds("{}({}, {})".format, st.sampled_from(["max", "min"]), deeper, deeper),
        st.builds("clip({}, -1, {})".format, deeper, st.sampled_from(["0.5", "2"])),
        st.builds("abs({})".format, deeper),
        conditional,
    )


@functools.cache
def conditions(depth: int) -> st.SearchStrategy[str]:
    signs = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
    value = expressions(min(depth, 1))
    simple = st.builds("{} {} {}".format, value, signs, value)
    if depth == 0:
        return simple
    deeper = conditions(depth - 1)
    return st.one_of(
        simple,
        st.builds("{} {} {} {} {}".format, value, signs, value, signs, value),
        st.builds("({}) {} ({})".format, deeper, st.sampled_from(["and", "or"]), deeper),
        st.builds("not ({})".format, deeper),
    )


@st.composite
def blocks(draw: st.DrawFn, depth: int) -> list[str]:
    """Lines of a block, which may end without an answer."""
    lines: list[str] = []
    for _ in range(draw(st.integers(1, 2))):
        kind = draw(st.sampled_from(["assign", "if"] if depth else ["assign"]))
        if kind == "assign":
            name = draw(st.sampled_from(["u", "w"]))
            lines.append(f"{name} = {name} + {draw(expressions(2))}")
            continue
        lines.append(f"if {draw(conditions(1))}:")
        lines += ["    " + line for line in draw(blocks(depth - 1))]
        if draw(st.booleans()):
            lines.append(f"elif {draw(conditions(1))}:")
            lines.append(f"    return {draw(expressions(1))}")
        if draw(st.booleans()):
            lines.append("else:")
            lines += ["    " + line for line in draw(blocks(depth - 1))]
    return lines


def run_by_python(lines: list[str], states: np.ndarray) -> np.ndarray:
    """Return what Python itself makes of a program, as the body of a function."""
    scope: dict[str, object] = {"clip": lambda value, low, high: min(max(value, low), high)}
    exec("def policy(x, y, z):\n" + "\n".join("    " + line for line in lines), scope)
    policy = scope["policy"]
    return np.array([policy(*state) for state in states.tolist()])  # type: ignore[operator]


@settings(max_examples=120)
@given(blocks(2), expressions(2))
def test_a_program_does_what_python_does(body: list[str], answer: str) -> None:
    lines = ["u = 1", "w = x - y", *body, f"return {answer}"]
    try:
        tree = otr.parse_program("\n".join(lines), NAMES, max_leaves=512)
    except otr.TreeTooLargeError:
        assume(False)
    np.testing.assert_array_equal(tree.predict(GRID)[:, 0], run_by_python(lines, GRID))


@pytest.mark.parametrize(
    ("sign", "on_the_boundary"),
    [("<", 0), ("<=", 1), (">", 0), (">=", 1), ("==", 1), ("!=", 0), ("≤", 1), ("≥", 1), ("≠", 0)],
)
def test_a_boundary_is_on_the_side_of_its_sign(sign: str, on_the_boundary: int) -> None:
    tree = parse(f"if 2 x {sign} y + 0.5 then 1 else 0")
    assert tree.predict([0.5, 0.5, 0.0]) == on_the_boundary
    assert tree.predict([np.nextafter(0.5, 0), 0.5, 0.0]) == (sign in ("<", "<=", "!=", "≤", "≠"))
    assert tree.predict([np.nextafter(0.5, 1), 0.5, 0.0]) == (sign in (">", ">=", "!=", "≥", "≠"))


SPELLINGS = {
    "one line": "if x <= 0: -1 else: 1",
    "then": "if x <= 0 then -1 else 1",
    "words on their own lines": "if x <= 0\nthen return -1\nelse return 1",
    "braces": "if (x <= 0) { return -1; } else { return 1; }",
    "braces on their own lines": "if x <= 0\n{\nreturn -1\n}\nelse\n{\nreturn 1\n}",
    "as in C": "if (x <= 0) return -1; else return 1; // left",
    "as in C, on lines": "if (x <= 0)\n    return -1;\nreturn 1;",
    "not indented": "if x <= 0 then\nreturn -1\nelse\nreturn 1\n",
    "end": "if x <= 0 then\nu = -1\nelse\nu = 1\nend\nreturn u",
    "end if": "IF x <= 0 THEN\n  u = -1\nELSE\n  u = 1\nEND IF;\nRETURN u",
    "colons and comments": "# a policy\n\nif x <= 0:   # falling\n    return -1\n\nelse:\n    return 1\n",
    "tabs": "if x <= 0:\n\treturn -1\nelse:\n\treturn 1",
    "indented as a whole": "    if x <= 0:\n        return -1\n    return 1",
    "windows": "if x <= 0:\r\n    return -1\r\nreturn 1\r\n",
    "unicode": "if x ≤ 0 then −1 else 1",
    "conditional expression": "return -1 if x <= 0 else 1",
    "if as an expression": "return if x <= 0 then -1 else 1",
    "the other way round": "if 0 >= x: -1 else: 1",
    "not": "if not x <= 0 then 1 else -1",
    "bang": "if (!(x <= 0)) { 1 } else { -1 }",
    "both sides": "if 2 x + y <= x + y then -1 else 1",
    "over lines": "if (x +\n0 <= 0)\n  then return -1\nreturn 3\n    - 2",
    "statements on a line": "u = 1; if x <= 0: u = -1;\nreturn u;",
    "default, then override": "u = -1\nif x > 0:\n    u = 1\nreturn u",
    "an output": "y0 = -1\nif x > 0 then y0 = 1",
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_spellings_of_one_program(text: str) -> None:
    tree = otr.parse_program(text, NAMES)
    assert (tree.n_leaves, tree.n_outputs, tree.head) == (2, 1, otr.Identity())
    np.testing.assert_array_equal(tree.predict(GRID)[:, 0], np.where(GRID[:, 0] <= 0, -1.0, 1.0))


@pytest.mark.parametrize(
    ("expression", "coefficients", "offset"),
    [
        ("-2.2 - 3.8 x + 114.3y", [-3.8, 114.3, 0], -2.2),
        ("2(x + 1) * 3", [6, 0, 0], 6),
        ("-(x - y) / 4", [-0.25, 0.25, 0], 0),
        ("x / 3", [1 / 3, 0, 0], 0),
        ("1/2*x - .5e1 + +y", [0.5, 1, 0], -5),
        ("2 · x − 3 × z", [2, 0, -3], 0),
        ("1 / 4 * x * 2", [0.5, 0, 0], 0),
        ("x - (y - (z - 1))", [1, -1, 1], -1),
        ("x - x + y", [0, 1, 0], 0),
        ("3 - -x", [1, 0, 0], 3),
    ],
)
def test_affine_expressions(expression: str, coefficients: list[float], offset: float) -> None:
    tree = parse(f"return {expression}")
    assert (tree.M[0, 0].tolist(), tree.c[0, 0]) == (coefficients, offset)


def test_an_else_belongs_to_the_if_that_is_indented_alike() -> None:
    tree = parse("""
        u = 0
        if x > 0:
            if y > 0:
                u = 1
        else:
            u = 2
        return u
    """)
    assert [tree.predict(state).item() for state in ([1, 1, 0], [1, 0, 0], [0, 1, 0])] == [1, 0, 2]


def test_without_braces_or_words_a_block_is_one_statement_as_in_c() -> None:
    for text in (
        "u = 0; if (x > 0) u = 1; else u = 2; u = u + 10; return u",
        "u = 0; if (x > 0) { u = 1; } else u = 2; u = u + 10; return u",
    ):
        assert parse(text).predict([[1.0, 0, 0], [0.0, 0, 0]])[:, 0].tolist() == [11, 12]
    with pytest.raises(otr.ProgramError, match="indented unlike"):  # in C the second line is no part of the block
        parse("if (x > 0)\n    u = 1;\n    w = 2;\nreturn 0;")


def elif_chain(n: int) -> str:
    lines = [f"{'elif' if i else 'if'} x <= {i} then return {i}" for i in range(n)]
    return "\n".join([*lines, f"else return {n}"])


def test_a_chain_of_thousands_takes_memory_by_its_length() -> None:
    def peak(n: int) -> int:
        tracemalloc.start()
        tree = otr.parse_program(elif_chain(n), NAMES)
        n_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert (tree.depth, tree.predict([n - 0.5, 0, 0]).item()) == (n, n)
        return n_bytes

    assert peak(2000) < 2.3 * peak(1000)
    with pytest.raises(otr.TreeTooLargeError, match="more than 1500 leaves"):
        otr.parse_program(elif_chain(2000), NAMES, max_leaves=1500)


def test_what_a_path_has_decided_is_found_however_far_above() -> None:
    n = 150
    chain = "\n".join(f"{'elif' if i else 'if'} {'x' if i % 3 else '-x'} <= {i}: u = {i}" for i in range(n))
    again = "\n".join(f"{'elif' if i else 'if'} {'x' if i % 3 else '-x'} <= {i}: w = u - {i}" for i in range(n))
    tree = otr.parse_program(f"{chain}\nelse: u = {n}\n{again}\nelse: w = u - {n}\nreturn w", NAMES)
    assert (tree.n_leaves, np.unique(tree.c).tolist()) == (n + 1, [0.0])  # every path knows its own tests again
    doors = "\n".join(f"if x > {i}: u = u + 1" for i in range(6))  # many nodes make each of these tests
    tree = otr.parse_program(f"u = 0\n{doors}\n{doors}\nreturn u", NAMES)
    assert tree.n_leaves == 2**6
    np.testing.assert_array_equal(tree.predict(GRID)[:, 0], 2 * sum(GRID[:, 0] > i for i in range(6)))


@pytest.mark.parametrize(("opening", "closing"), [("then {", "}"), ("{", "}"), ("then\n", ""), (": ", "")])
def test_thousands_of_blocks_within_each_other(opening: str, closing: str) -> None:
    n = 5000
    text = "".join(f"if x > {i} {opening}" for i in range(n)) + "return 1"
    if closing:
        text += f" {closing}" * n + "return 2"
    else:
        text += "\nelse return 2" * n
    tree = otr.parse_program(text, NAMES)
    assert tree.depth == n
    assert tree.predict([[n + 1.0, 0, 0], [n - 1.5, 0, 0], [-1.0, 0, 0]])[:, 0].tolist() == [1, 2, 2]


def test_a_sum_of_thousands_of_terms() -> None:
    names = [f"bit_{i}" for i in range(3000)]
    tree = otr.parse_program("return 1 + " + " + ".join(f"{i} {name}" for i, name in enumerate(names)), names)
    np.testing.assert_array_equal(tree.M[0, 0], np.arange(3000.0))


def test_tests_that_are_settled_are_left_out() -> None:
    tree = parse("""
        k = 2
        if k > 1 then u = x else u = y
        if u <= 1 then w = 1 else w = 2
        if u <= 1 then return w         # settled by the line above
        if -u >= -1 then return 5       # the same test once more
        if u > 1 then return 3
        return y * 0
    """)
    assert tree.n_leaves == 2
    assert sorted(tree.c[:, 0].tolist()) == [1.0, 3.0]
    assert parse("if x > 0 then 1 else if -x < 0 then 2 else 3").n_leaves == 2


def test_clips_of_all_answers_are_the_head() -> None:
    box = otr.ClipBox([-1.0], [2.0])
    for text in (
        "return clip(3 x, -1, 2)",
        "return max(min(3 x, 2), -1)",
        "return min(2, max(-1, 3 x))",
        "return min(max(3 x, -1, -5), 2, 7)",
        "u = clip(3 x, -1, 2)\nreturn u",
    ):
        tree = parse(text)
        assert (tree.n_leaves, tree.head, tree.M.tolist()) == (1, box, [[[3.0, 0.0, 0.0]]])
    with_constant = parse("if x <= 0 then return -1 else return clip(y, -1, 2)")
    assert (with_constant.n_leaves, with_constant.head) == (2, box)


@pytest.mark.parametrize(
    ("text", "n_leaves"),
    [
        ("return max(x, -1)", 2),
        ("if x <= 0 then return -3 else return clip(y, -1, 2)", 4),
        ("if x <= 0 then return clip(y, -2, 2) else return clip(y, -1, 2)", 6),
        ("return clip(x, -1, 1) + 1", 3),
        ("return clip(x, -1, 1), y", 3),
        ("return clip(clip(x, -3, 3) + y, -1, 1) * 2", 9),
    ],
)
def test_other_clips_are_tests(text: str, n_leaves: int) -> None:
    tree = parse(text)
    assert (tree.n_leaves, tree.head) == (n_leaves, otr.Identity())


def test_tanh_is_a_head() -> None:
    tree = parse("y0 = 0.5 - 2 * tanh(x + 1)\ny1 = tanh(y) / 4", output_names=["y0", "y1"])
    assert tree.head == otr.TanhBox([-1.5, -0.25], [2.5, 0.25])
    X = GRID[::7]
    expected = np.stack((0.5 - 2 * np.tanh(X[:, 0] + 1), np.tanh(X[:, 1]) / 4), axis=1)
    np.testing.assert_allclose(tree.predict(X), expected, rtol=1e-14, atol=1e-15)


def test_several_outputs() -> None:
    texts = ("return x, 2", "return [x, 2]", "return (x, 2)", "thrust = 2\nturn = x", "(x, 2)")
    for text in texts:
        tree = parse(text, output_names=["turn", "thrust"])
        assert (tree.M[0].tolist(), tree.c[0].tolist()) == ([[1, 0, 0], [0, 0, 0]], [0, 2])


def test_labels_by_name_number_and_argmax() -> None:
    text = "if x > 0 then return 2 else if y > 0 then fire else return argmax(0, z, 1)"
    tree = parse(text, labels=True, output_names=["coast", "fire", "left engine"])
    states = [[1, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 0, 2]]
    assert tree.predict(states).tolist() == [2, 1, 2, 1, 1]  # of equals the first
    assert (tree.n_outputs, tree.head) == (3, otr.Argmax())
    np.testing.assert_array_equal(tree.forward(states).argmax(axis=1), tree.predict(states))
    spaced = parse("if x > 0 then left engine else coast", labels=True, output_names=["coast", "fire", "left engine"])
    assert spaced.predict([[1, 0, 0], [0, 0, 0]]).tolist() == [2, 0]
    assert parse("return 1 if x > 0 else 0", labels=True).predict([[1, 0, 0]]).dtype.kind == "i"


def test_names_that_are_no_words() -> None:
    names = ["left contact", "left contact 2", "C#N", "2nd angle", "θ"]
    tree = otr.parse_program("return 2 left contact 2 - 3 left contact + C#N + 4 2nd angle + 2θ # C#N", names)
    assert tree.M[0, 0].tolist() == [-3, 2, 1, 4, 2]
