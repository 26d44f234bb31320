"""A name is never code: whatever inputs and answers are called, a program stays the program, in every format."""

from __future__ import annotations

import ast
import functools
import io
import json
import re
import shutil
import subprocess
import tokenize
import unicodedata
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import otr
from otr.programs.latex import math_name
from otr.programs.names import names_for, one_line
from tests.programs.controller import FunctionBlock
from tests.programs.hostile import TREES, WORDS, named_trees, names
from tests.programs.policies import assert_answers, states_for
from tests.programs.test_c import COMPILER, FLAGS, compiled, runner
from tests.programs.test_json import answer as answer_of_json
from tests.programs.test_onnx import run as run_onnx

Named = tuple[otr.ObliqueTree, list[str], list[str]]
Write = Callable[..., str]


def written(write: Write, case: Named, **options: Any) -> str:
    tree, features, outputs = case
    text = write(tree, feature_names=features, output_names=outputs, **options)
    text.encode()  # a file can hold it
    return text


def prints(text: str) -> bool:
    """Whether a text is lines of characters that print, and no other breaks of lines."""
    return all(c in "\n " or unicodedata.category(c)[0] not in "CZ" for c in text)


COOKIE = ["coding: unicode_escape \\u000aimport os; os.abort()", "x1"]


@settings(max_examples=200)
@given(named_trees())
@example((TREES["plain"], COOKIE, ["y0", "y1"]))
@example((TREES["labels"], ["x0", "x2"], COOKIE))
@example((TREES["plain"], ["x" * 100, "y" * 100], ["z" * 100, "u" * 100]))
@example((TREES["squashed"], ["if " * 60, "else"], ["\f import", "\r\n"]))
def test_python(case: Named) -> None:
    tree, states = case[0], states_for(case[0], 12)
    program = written(otr.to_python, case)
    assert prints(program)
    assert program.splitlines()[:2] == otr.to_python(tree).splitlines()[:2]
    source = program.encode()
    assert tokenize.detect_encoding(io.BytesIO(source).readline)[0] == "utf-8"
    kinds = [type(node) for node in ast.parse(source).body]
    assert [kind for kind in kinds if kind is not ast.ImportFrom] == [ast.FunctionDef]
    scope: dict[str, Any] = {}
    exec(compile(source, "policy", "exec"), scope)
    assert_answers(tree, states, [scope["policy"](state) for state in states.tolist()])


@pytest.mark.parametrize("name", ["coding", "ﬁt", "policy_" + "x" * 100])
def test_the_name_of_the_python_function_declares_no_encoding(name: str) -> None:
    tree = TREES["squashed"]
    scope: dict[str, Any] = {}
    exec(compile(otr.to_python(tree, name=name).encode(), "policy", "exec"), scope)
    np.testing.assert_allclose(scope[unicodedata.normalize("NFKC", name)]([0.5, 0.25]), tree.predict([0.5, 0.25]))


@pytest.mark.parametrize("name", ["ｉｆ", "ｔanh", "__debug__"])
def test_what_python_reads_as_another_word_is_no_name(name: str) -> None:
    with pytest.raises(ValueError, match="cannot be the name of the Python function"):
        otr.to_python(TREES["squashed"], name=name)


@functools.cache
def without_comments(source: str) -> str:
    command = [str(COMPILER), "-std=c99", "-trigraphs", "-fpreprocessed", "-E", "-P", "-x", "c", "-"]
    return subprocess.run(command, input=source.encode(), capture_output=True, check=True).stdout.decode()


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler (gcc or cc) on the PATH")
@settings(max_examples=25)
@given(case=named_trees())
@example(case=(TREES["plain"], ["a */ int b; /*", "??/"], ["??/\n*/", "\\"]))
def test_c(case: Named, tmp_path_factory: pytest.TempPathFactory) -> None:
    tree, states = case[0], states_for(case[0], 12)
    source = written(otr.to_c, case)
    assert prints(source)
    assert without_comments(source) == without_comments(otr.to_c(tree))
    library = compiled({"policy": source}, tmp_path_factory.mktemp("c"))
    assert_answers(tree, states, runner(library, "policy", source)(states))


# The last line is of GNU C.
C_NAMES = """
    x y i j k z a u row sum odd node best gains class asm bool y0 car Policy_2
    typeof sin expf atan2l conj malloc isalnum printf isnan nan NAN INFINITY div
    int8_t uintptr_t INT8_MAX SIZE_MAX FP_NAN M_PI
    linux unix finite index gamma gammaf_r sqrtf64x stpcpy feclearexcept signgam putc_unlocked
"""


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler (gcc or cc) on the PATH")
def test_a_name_of_a_c_function_compiles_or_is_refused(tmp_path: Path) -> None:
    taken = []
    for name in (*WORDS, *C_NAMES.split(), "p" * 200):
        try:
            for kind in ("plain", "squashed", "labels", "pid"):
                (tmp_path / f"{name}_{kind}.c"[-99:]).write_text(otr.to_c(TREES[kind], name=name))
        except ValueError as error:
            assert "cannot be the name of a C function" in str(error)
            taken.append(name)
    assert {"exp", "class", "isnan", "INT8_MAX", "else"} <= set(taken)
    assert not {"car", "x", "gains", "Policy_2", "p" * 200, "limit", "def"} & set(taken)
    for flags in (FLAGS, FLAGS[1:]):  # C99, and what the compiler takes by itself
        command = [str(COMPILER), *flags, "-fsyntax-only", *map(str, tmp_path.iterdir())]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def code_of(text: str) -> str:
    """Return structured text without its comments, which may be nested."""
    parts, depth = [], 0
    for part in re.split(r"(\(\*|\*\))", text):
        depth += {"(*": 1, "*)": -1}.get(part, 0)
        assert depth in (0, 1), "a comment opens another, or is closed twice"
        parts += [part] if depth == 0 and part != "*)" else []
    assert depth == 0
    return "".join(parts)


def placeholders(text: str, identifiers: list[str]) -> list[str]:
    """Return the words of a program with each identifier by its number."""
    numbers = {identifier.lower(): f"#{i}" for i, identifier in enumerate(identifiers)}
    return [numbers.get(word.lower(), word) for word in re.findall(r"\w+|[^\w\s]+", code_of(text))]


@settings(max_examples=200)
@given(named_trees())
def test_structured_text(case: Named) -> None:
    tree = case[0]
    text, plain = written(otr.to_structured_text, case), otr.to_structured_text(tree)
    assert prints(text)
    declared = [re.findall(r"((?:\w+,\s+)*\w+)\s+:\s+LREAL;", code_of(program)) for program in (text, plain)]
    found, usual = ([name for group in groups for name in re.split(r",\s+", group)] for groups in declared)
    assert len({identifier.lower() for identifier in found}) == len(found)
    assert all(re.fullmatch(r"[A-Za-z](_?[A-Za-z0-9])*", identifier) for identifier in found)
    assert placeholders(text, found) == placeholders(plain, usual)


@settings(max_examples=8)
@given(st.lists(names(), min_size=3, max_size=3, unique=True))
@example(["*) END_VAR (*", "(*)", "{pragma"])
@example(["END_IF", "x" * 200, "Decay"])
def test_structured_text_is_parsed_and_played(given_names: list[str]) -> None:
    tree = otr.ObliqueTree([~0], [~1], [[1.5, -0.25]], [0.5], [[[1.0, 0.0]], [[0.0, -2.0]]], [[0.5], [0.25]])
    block = FunctionBlock(written(otr.to_structured_text, (tree, given_names[:2], given_names[2:])))
    states = states_for(tree, 12)
    assert_answers(tree, states, [list(block(*state).values()) for state in states.tolist()])


@settings(max_examples=300)
@given(named_trees())
@example((TREES["plain"], ["x", "- 2 x"], ["y", "y = x"]))
@example((TREES["plain"], ["x + `", "`"], ["\\", "\\`\n"]))
@example((TREES["labels"], ["then", "3"], ["1", "0"]))
@example((TREES["constant"], ["left contact", "2 left"], ["left", "contact 2"]))
def test_text_is_read_back_whatever_names_hold(case: Named) -> None:
    tree, features, outputs = case
    if tree is TREES["pid"]:
        return  # gains and terms are for people
    text = written(otr.to_text, (tree, features, outputs), precision=17)
    assert prints(text)
    labels = tree.labels is not None or isinstance(tree.head, otr.Argmax)
    parsed = otr.parse_program(text, features, output_names=outputs, labels=labels)
    assert_answers(tree, states_for(tree, 40), parsed.predict(states_for(tree, 40)))


@pytest.mark.parametrize(
    "name", ["then", ":", ";", "{", "}", "(", ")", ",", "=", "if", "else", "elif", "end", "return"]
)
def test_a_name_between_backquotes_is_no_word_of_the_language(name: str) -> None:
    tree = TREES["plain"]
    text = otr.to_text(tree, output_names=[name, "other"], precision=17)
    parsed = otr.parse_program(text, ["x0", "x1"], output_names=[name, "other"])
    assert_answers(tree, states_for(tree, 40), parsed.predict(states_for(tree, 40)))
    text = "if (a > 0) `" + name + "`, (`" + name + "` + 1) else 1, 2"
    parsed = otr.parse_program(text, ["a", name], output_names=["y", "z"])
    assert parsed.predict([[1.0, 5.0], [-1.0, 5.0]]).tolist() == [[5.0, 6.0], [1.0, 2.0]]


def read_by_tex(formula: str) -> str:
    """Return what TeX prints for a name in a formula, which holds nothing but what stands for a character."""
    words = ("backslash", "asciicircum", "asciitilde", "less", "greater", "bar")
    printed = dict(zip((f"text{word}" for word in words), "\\^~<>|", strict=True))
    group = re.fullmatch(r"\\textit\{(.*)\}|([A-Za-z])_\{(\d+)\}|([A-Za-z])", formula, re.S)
    assert group is not None
    if group[1] is None:
        return group[4] or group[2] + group[3]
    text = ""
    for word, sign, rest in re.findall(r"\\([A-Za-z]+)\{\}|\\([{}$&#%_])|(.)", group[1], re.S):
        assert rest not in ("\\", "{", "}", "$", "&", "#", "%", "_", "^", "~"), f"{rest} means something to TeX"
        text += printed[word] if word else sign or rest
    return text.replace("''", '"')


@settings(max_examples=200)
@given(named_trees())
def test_latex(case: Named) -> None:
    tree = case[0]
    text = written(otr.to_latex, case, precision=17)
    assert prints(text)
    shown = names_for(*case)
    formulas = [math_name(name) for name in (*shown.features, *shown.answers)]
    for name, formula in zip((*shown.features, *shown.answers), formulas, strict=True):
        written_out, given_name = (each.replace('"', "''").replace("_", "") for each in (read_by_tex(formula), name))
        assert written_out == given_name  # TeX sets two apostrophes where a quotation mark was
    words = [f"word{'abcdef'[i]}" for i in range(tree.n_inputs + 2)]
    plain = otr.to_latex(tree, feature_names=words[:-2], output_names=words[-2:], precision=17)
    by_word = dict(zip(words, formulas, strict=True))
    expected = re.sub(r"\\textit\{(word[a-f])\}", lambda match: by_word[match[1]], plain)
    if tree.labels is not None:  # labels are words, not formulas
        expected = re.sub(r"(?<=return} )(\w)\b", r"\\textit{\1}", expected)
        expected = re.sub(r"(?<=return} )(\w)_\{(\d+)\}", r"\\textit{\1\2}", expected)
        text = re.sub(r"(?<=return} )(\\textit\{\w)\\_(\d+\})", r"\1\2", text)
    assert text == expected


def cells(text: str) -> list[list[str]]:
    """Return the texts in the labels of a graph's boxes, and check that the rest is what it always is."""
    found = []
    for line in text.splitlines()[1:-1]:
        label = re.fullmatch(r"    n\d+ \[label=<(<TABLE .*</TABLE>)>, style=\"[^\"]*\".*\];", line)
        assert label or re.fullmatch(r'    (graph|node|edge|n\d+ -> n\d+) \[[^\[\]]*(\[.*\])?[^\[\]]*"?.*\];', line)
        if label:
            table = ET.fromstring(label[1])
            assert {part.tag for part in table.iter()} <= {"TABLE", "TR", "TD", "B"}
            found.append([part.text or "" for part in table.iter() if part.tag in ("TD", "B") and not len(part)])
    return found


@settings(max_examples=200)
@given(named_trees())
def test_dot(case: Named) -> None:
    tree = case[0]
    text = written(otr.to_dot, case, max_terms=9)
    assert prints(text)
    shown = names_for(*case)
    words = [f"word{'abcdef'[i]}" for i in range(tree.n_inputs + 2)]
    plain = otr.to_dot(tree, feature_names=words[:-2], output_names=words[-2:], max_terms=9)
    by_word = dict(zip(words, (*shown.features, *shown.answers), strict=True))
    expected = [[re.sub("word[a-f]", lambda m: by_word[m[0]], cell) for cell in box] for box in cells(plain)]
    assert cells(text) == expected
    assert len(text.splitlines()) == len(plain.splitlines())


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")
@settings(max_examples=20)
@given(named_trees())
def test_graphviz_draws_it(case: Named) -> None:
    done = subprocess.run(["dot", "-Tsvg"], input=written(otr.to_dot, case).encode(), capture_output=True, check=False)
    assert done.returncode == 0 and not done.stderr, done.stderr.decode()


def whole(name: str) -> str:
    """Return a name with the halves of characters put together, as UTF-16 does; a half alone stays."""
    return name.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")


@settings(max_examples=100)
@given(named_trees())
@example((TREES["plain"], ["\ud800\udfff", "\udfff\ud800"], ["\ud800", "y1"]))
def test_json(case: Named) -> None:
    tree, features, outputs = case
    program = json.loads(written(otr.to_json, case))
    # JSON's escapes are of UTF-16, where two halves in a row are the character they make.
    features, outputs = ([whole(name) for name in names] for names in (features, outputs))
    assert (program["features"], program["outputs"]) == (features, outputs)
    states = states_for(tree, 12)
    assert_answers(tree, states, [answer_of_json(program, state) for state in states.tolist()])


@settings(max_examples=20)
@given(named_trees())
def test_onnx(case: Named) -> None:
    tree, features, outputs = case
    model = otr.to_onnx(tree, feature_names=features, output_names=outputs)
    metadata = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    assert (metadata["features"], metadata["outputs"]) == (features, outputs)
    assert_answers(tree, states_for(tree, 12), run_onnx(model, states_for(tree, 12)))


@pytest.mark.parametrize("name", ["", " ", "a\nb", "\ud800", "\0"])
def test_a_name_that_no_graph_has_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected one line of characters that print"):
        otr.to_onnx(TREES["plain"], name=name)


@settings(max_examples=15)
@given(named_trees(), names())
@example((TREES["plain"], ["-->", "\0"], ["]]>", "$x_2$"]), "--><script>")
@pytest.mark.filterwarnings("ignore:Glyph:UserWarning", "ignore:Matplotlib currently does not support:UserWarning")
def test_pictures(case: Named, title: str) -> None:
    tree, features, outputs = case
    figure = otr.draw_tree(tree, feature_names=features, output_names=outputs, title=title)
    shown = [text.get_text() for text in figure.axes[0].texts]
    assert all("\n" not in text and prints(text) for text in shown)
    assert one_line(title) in shown or not one_line(title)
    drawn = ET.fromstring(otr.to_svg(tree, feature_names=features, output_names=outputs, title=title))
    assert {part.tag.rpartition("}")[2] for part in drawn.iter()} <= {"svg", "title", "rect", "path", "text"}
    assert [part.text for part in drawn.iter("{http://www.w3.org/2000/svg}text")] == shown
    file = io.BytesIO()
    figure.savefig(file, format="svg")
    assert {part.tag.rpartition("}")[2] for part in ET.fromstring(file.getvalue()).iter()} <= {
        "svg", "metadata", "RDF", "Work", "type", "date", "format", "creator", "Agent", "title", "defs", "style", "g",
        "path", "use", "clipPath", "rect",
    }  # fmt: skip


@pytest.mark.parametrize(
    "write", [otr.to_text, otr.to_python, otr.to_c, otr.to_structured_text, otr.to_latex, otr.to_dot, otr.to_json]
)
def test_what_is_no_text_is_no_name(write: Write) -> None:
    with pytest.raises(TypeError, match=r"feature_names\[1\] is 3 of type int, expected a str"):
        write(TREES["plain"], feature_names=["x", 3])


WRITERS = [
    otr.to_text, otr.to_python, otr.to_c, otr.to_structured_text, otr.to_latex, otr.to_dot, otr.to_json, otr.to_onnx,
    otr.draw_tree, otr.to_svg,
]  # fmt: skip


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize(
    ("names_given", "message"),
    [
        ({"feature_names": ["a", "a"]}, "feature_names has 'a' twice; give one of them another name"),
        ({"output_names": ["a", "a"]}, "output_names has 'a' twice; give one of them another name"),
        (
            {"feature_names": ["a", "b"], "output_names": ["c", "b"]},
            "output_names has 'b', which is an input's name, too",
        ),
        ({"feature_names": ["a", "y1"]}, "output_names has 'y1', which is an input's name, too"),
        ({"feature_names": "ab"}, "feature_names is the text 'ab', expected a list of names"),
        ({"output_names": "ab"}, "output_names is the text 'ab', expected a list of names"),
    ],
)
def test_names_that_do_not_tell_one_from_another_are_refused(write: Write, names_given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write(TREES["plain"], **names_given)


def test_a_label_without_a_name_may_have_the_number_that_an_input_is_called() -> None:
    text = otr.to_text(TREES["labels"], feature_names=["0", "1"], precision=17)
    parsed = otr.parse_program(text, ["0", "1"], labels=True)
    states = states_for(TREES["labels"], 40)
    assert_answers(TREES["labels"], states, parsed.predict(states))
    with pytest.raises(ValueError, match="output_names has '1', which is an input's name, too"):
        otr.to_text(TREES["labels"], feature_names=["0", "1"], output_names=["up", "1"])
