"""Programs as others print them, in this language's words: C and Python functions, trees of scikit-learn and dtControl.

Each line stays on its line, but for DOT, whose nodes become nested conditions.
"""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NoReturn

from otr.errors import ProgramError
from otr.programs.language.tokens import KEYWORDS, QUOTED, written

_PYTHON = re.compile(r'(?m)^[ \t]*def\s+\w+\s*\([^)]*\)\s*(?:->[^:\n]*)?:(?:\s*("""|\'\'\')[\s\S]*?\1)?')
_C = re.compile(r"(?m)^[ \t]*(?:[A-Za-z_]\w*[ \t*]+)+?(\w+)[ \t]*\(([^()]*)\)\s*([{;])")
_TYPE = r"\b(?:const\s+)?(?:float|double|int)\s+"
_INTEGER = re.compile(r"\b(?:u?int\w*|long|short|char|signed|unsigned|_?[Bb]ool|size_t)\b(?!.*\bdouble\b)")
_LEFT_ALONE = rf"{QUOTED}|(?:#|//).*"
_BLOCK_COMMENT = re.compile(rf"{QUOTED}|//.*|#(?!include\b).*|(/\*[\s\S]*?\*/)")
_SCOPED = re.compile(rf"{_LEFT_ALONE}|[{{}}]|\b(float|double|int)\s+(\w+)\s*(?:;|=)")
_INDEXED = re.compile(rf"{_LEFT_ALONE}|(?<![\w.])([A-Za-z_]\w*)[ \t]*\[[ \t]*(0|[1-9]\d*)[ \t]*\](\s*=(?!=))?")
_FLOAT = re.compile(rf"{_LEFT_ALONE}|(?<![\w.])((?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)[fF]\b")
_TEXT_LINE = re.compile(r"((?:\|   )*)\|--- (.*)")
_NODE = re.compile(r'\s*"?(\w+)"?\s*\[(.*)\]\s*;?\s*')
_EDGE = re.compile(r'\s*"?(\w+)"?\s*->\s*"?(\w+)"?\s*(?:\[(.*)\])?\s*;?\s*')
_LABEL = re.compile(r'\blabel\s*=\s*(?:"((?:[^"\\]|\\.)*)"|<(.*)>)', re.DOTALL)
_COMPARED = re.compile(r"(.+?) ?(<=|>=|<|>)\s*([^<>=]+)")  # a name may end with spaces
# A statement of DOT ends with a semicolon or its line, except in quotes or brackets.
_IN_ANGLES, _IN_QUOTES = r"<(?:[^<>]|<[^<>]*>)*>", r'"(?:[^"\\]|\\.)*"'
_STATEMENT = re.compile(rf'(?:{_IN_QUOTES}|\[(?:{_IN_QUOTES}|{_IN_ANGLES}|[^\]"<])*\]|[^;\n"\[])+')


@dataclass(frozen=True)
class Translation:
    """A program's text in this language's words, and what C or Python says besides its statements."""

    text: str
    language: Literal["", "C", "Python"] = ""  # of the function that the text is the body of
    answers: str = ""  # the type of C's function
    integers: frozenset[str] = frozenset()  # variables of type int
    outputs: str = ""  # the array whose elements are given values


def in_our_words(text: str, features: Sequence[str], outputs: Sequence[str] | None) -> Translation:
    """Return a program's text as `parse_program` reads it, or the text itself where it is that, without ``/* */``.

    ``x[2]`` of any one array is the third feature, as is ``feature_2``, and ``result[0] = 1`` gives the first output
    its value.

    Raises:
        ProgramError: the array has no such place, there are two arrays or functions, a variable of C's function hides
            another, an input is an integer, or a tree was cut when printed.
    """
    translation = Translation(text)
    if re.match(r"\s*(?:strict\s+)?digraph\b", text):
        text = _dot(text, features, outputs or ())
    elif re.match(r"\s*\|--- ", text):
        lines = enumerate(text.split("\n"), start=1)
        text = "\n".join(_text_line(line, number, features, outputs or ()) for number, line in lines)
    else:
        if not any("/*" in name for name in (*features, *(outputs or ()))):
            text = _BLOCK_COMMENT.sub(lambda match: re.sub(r"\S", " ", match[0]) if match[1] else match[0], text)
        translation = _without_functions(text, features)
        text = translation.text
    names = (*features, *(outputs or ()), *re.findall(r"\b([fF])\s*:?=(?!=)", text))
    if not any(name in ("f", "F") or _FLOAT.search(name) for name in names):
        text = _FLOAT.sub(lambda match: match[1] or match[0], text)
    text, array = _without_indices(text, features, outputs)
    return replace(translation, text=text, outputs=array)


def _without_functions(text: str, features: Sequence[str]) -> Translation:
    """Return the body of the one function of C or Python, and spaces for what is around it."""
    whole = text
    bodies = list(_PYTHON.finditer(text))
    for match in bodies:
        text = _blanked(text, *match.span())
    found = [each for each in _C.finditer(text) if not KEYWORDS & set(re.findall(r"\w+", each[0].partition("(")[0]))]
    functions = [match for match in found if match[3] == "{"]
    integers = _integers(text, functions, features) if functions else frozenset()
    if functions:
        text = re.sub(_TYPE + r"\w+\s*;|" + _TYPE + r"(?=\w+\s*=)", "", text)
        found = [each for each in _C.finditer(text) if each[1] in {function[1] for function in functions}]
        for match in reversed(found):
            is_main = match[1] == "main" and len(functions) > 1
            if match[3] == ";" or is_main:
                text = _blanked(text, match.start(), match.end() if match[3] == ";" else _closing(text, match))
            else:  # what is in braces may be indented in any way
                lines = "\n" * match[0].count("\n")
                text = f"{text[: match.start()]}{lines}if (0 < 1) {{{text[match.end() :]}"
        bodies += [match for match in functions if match[1] != "main" or len(functions) == 1]
    if len(bodies) > 1:
        _refuse("a second function; give the text of one alone", whole, bodies[1].start())
    if not functions:
        return Translation(text, "Python" if bodies else "")
    answers = re.sub(r"\b(?:const|static|inline|extern)\b|[(].*", "", bodies[0][0].replace("\n", " ")).split()[:-1]
    return Translation(text, "C", " ".join(answers), integers)


def _integers(text: str, functions: list[re.Match[str]], features: Sequence[str]) -> frozenset[str]:
    """Return the variables of type int; refuse integers as inputs or outputs, and a name that hides another."""
    for function in functions:
        for parameter in function[2].split(","):
            is_read = re.search(r"[*\[]", parameter) or set(re.findall(r"\w+", parameter)[-1:]) & set(features)
            if _INTEGER.search(parameter) and is_read:
                _refuse(f"{parameter.strip()} holds integers, to which C rounds; write double", text, function.start())
    scopes: list[set[str]] = [set()]
    integers = set()
    for match in _SCOPED.finditer(text):
        if match[0] == "{":
            scopes.append(set())
        elif match[0] == "}":
            scopes = scopes[:-1] or [set()]
        elif match[2]:
            if any(match[2] in scope for scope in scopes):
                _refuse(f"a second {match[2]!r} hides the first; give it another name", text, match.start())
            scopes[-1].add(match[2])
            integers |= {match[2]} if match[1] == "int" else set()
    return frozenset(integers)


def _closing(text: str, opening: re.Match[str]) -> int:
    """Return the place after the brace that closes a function's, or the text's end."""
    depth = 1
    for match in re.finditer(r"[{}]", text[opening.end() :]):
        depth += 1 if match[0] == "{" else -1
        if not depth:
            return opening.end() + match.end()
    return len(text)


def _blanked(text: str, start: int, end: int) -> str:
    return text[:start] + re.sub(r"[^\n]", " ", text[start:end]) + text[end:]


def _without_indices(text: str, features: Sequence[str], outputs: Sequence[str] | None) -> tuple[str, str]:
    """Return the text with names in place of ``x[2]``, or ``result[0] =``, and the array of outputs, "" if none is."""
    arrays: dict[bool, str] = {}

    def named(match: re.Match[str]) -> str:
        if match[1] is None or match[1] in KEYWORDS:
            return match[0]
        array, index, is_output = match[1], int(match[2]), match[3] is not None
        element = f"{array}[{index}]"
        if any(element in name for name in (*features, *(outputs or ()))):  # which may be of several words
            return match[0]
        if arrays.setdefault(is_output, array) != array:
            _refuse(f"{element}, where {arrays[is_output]}[...] was an array before; give one", text, match.start())
        if arrays.get(not is_output) == array:
            _refuse(
                f"{element} is both read and given a value; give what is read a name of its own", text, match.start()
            )
        names = outputs if is_output else features
        if names is None:
            return f"y{index}{match[3]}"
        if index >= len(names):
            kind = "outputs" if is_output else "inputs"
            _refuse(f"there is no {element}: the {kind} are {len(names)}, from {array}[0] on", text, match.start())
        return written(names[index]) + (match[3] or "")

    text = _INDEXED.sub(named, text)
    return text, arrays.get(True, "")


def _text_line(line: str, number: int, features: Sequence[str], outputs: Sequence[str]) -> str:
    """Return a line of scikit-learn's `export_text`: a test is `if`, what it tests again is `else`."""
    match = _TEXT_LINE.fullmatch(line.rstrip())
    if match is None:
        return line
    indent, content = match[1].replace("|", " "), match[2]
    if content.startswith("truncated branch"):
        raise ProgramError("the tree was cut when it was printed; give export_text a larger max_depth", number, 1, line)
    answer = re.fullmatch(r"(?:weights: \[.*\] )?(?:class|value): (.*)", content)
    if answer:
        return f"{indent}return {_answer(answer[1], outputs)}"
    test = _test(content, features)
    return f"{indent}else:" if re.fullmatch(r".* > +\S+", content) else f"{indent}if {test}:"


def _dot(text: str, features: Sequence[str], outputs: Sequence[str]) -> str:
    """Return the program of a tree in DOT: a node's first edge, or that called True, is where its test holds."""
    labels: dict[str, tuple[str, int]] = {}  # and where the node is
    edges: dict[str, list[tuple[str, str]]] = {}
    # A node's text may break its line; statements end with semicolons, or lines.
    at = text.index("{") + 1
    for statement in _STATEMENT.finditer(text[at:]):
        edge, node = _EDGE.fullmatch(statement[0]), _NODE.fullmatch(statement[0].replace("\n", " "))
        if edge:
            edges.setdefault(edge[1], []).append((edge[2], edge[3] or ""))
        elif node and (found := _LABEL.search(node[2])):
            labels[node[1]] = (_plain_label(found), at + statement.start())
    targets = {target for each in edges.values() for target, _ in each}
    roots = [name for name in labels if name not in targets]
    if len(roots) != 1:
        _refuse(f"the graph has {len(roots)} nodes that no edge leads to; a tree has one", text, 0)
    lines: list[str] = []
    pending: list[tuple[str | None, str, str]] = [(roots[0], "", "")]  # node, indentation, or a line alone
    seen: set[str] = set()
    while pending:
        name, indent, line = pending.pop()
        if name is None:
            lines.append(line)
            continue
        label, place = labels.get(name, ("", 0))
        if name in seen or name not in labels or label == "(...)":
            why = "is there twice" if name in seen else "is cut, or has no label; print the whole tree"
            _refuse(f"node {name} {why}", text, place)
        seen.add(name)
        children = edges.get(name, [])
        if not children:
            lines.append(f"{indent}return {_leaf(label, outputs, text, place)}")
            continue
        if len(children) != 2:
            _refuse(f"node {name} has {len(children)} edges; a test has two", text, place)
        yes, no = reversed(children) if '"True"' in children[1][1] else children
        lines.append(f"{indent}if {_test(_first_test(label), features)}:")
        pending += [(no[0], indent + "  ", ""), (None, "", f"{indent}else:"), (yes[0], indent + "  ", "")]
    return "\n".join(lines)


def _plain_label(label: re.Match[str]) -> str:
    """Return a node's text with its lines divided by line breaks."""
    if label[2] is not None:
        text = re.sub(r"(?i)<sub>(\d+)</sub>", r"[\1]", re.sub(r"<br\s*/?>", "\n", label[2]))
        return html.unescape(text).replace("≤", "<=")
    return label[1].replace("\\n", "\n").replace('\\"', '"')


def _first_test(label: str) -> str:
    """Return the test at a label's beginning, which dtControl breaks before each term."""
    lines = [line for line in label.split("\n") if not re.match(r"node #\d+$", line)]
    n = next((i for i, line in enumerate(lines) if _COMPARED.fullmatch(line)), 0)
    return " ".join(lines[: n + 1])


def _leaf(label: str, outputs: Sequence[str], text: str, place: int) -> str:
    """Return what a leaf answers: its class, or its values, of which a program of labels takes the largest."""
    called = re.search(r"(?m)^class = (.*)$", label)
    value = re.search(r"(?s)\bvalue = (.*?)(?:\nclass = |$)", label)
    if called:
        return _answer(called[1], outputs)
    if value is None and label.lstrip().startswith(("[", "{")):
        _refuse(f"a leaf allows several answers, {label}; determinise the controller first", text, place)
    if value is None:
        return _answer(label, outputs)
    numbers = ", ".join(re.findall(r"[-+]?[\d.]+(?:e[-+]?\d+)?", value[1]))
    return f"argmax({numbers})" if re.search(r"(?m)^(gini|entropy|log_loss) = ", label) and "," in numbers else numbers


def _answer(answer: str, outputs: Sequence[str]) -> str:
    """Return an answer's numbers without brackets, or its class, which may be named as a number is."""
    if answer in outputs:
        return written(answer)
    inner = answer.strip().strip("[]()")
    is_numbers = re.fullmatch(r"[-+\d.eEfF,\s]+", inner) is not None
    return re.sub(r"\s*,\s*", ", ", inner) if is_numbers else written(answer.strip())


def _test(content: str, features: Sequence[str]) -> str:
    """Return a test as an expression; one feature on its left may have any name."""
    match = _COMPARED.fullmatch(content)
    if match is None:
        return content
    left = match[1] if match[1] in features else match[1].strip()
    numbered = re.fullmatch(r"feature_(\d+)", left)
    if left in features:
        left = written(left)
    elif numbered:
        left = f"x[{numbered[1]}]"
    return f"{left} {match[2]} {match[3]}"


def _refuse(reason: str, text: str, at: int) -> NoReturn:
    """Raise the error for a place in the text."""
    line = text.count("\n", 0, at)
    raise ProgramError(reason, line + 1, at - text.rfind("\n", 0, at), text.split("\n")[line])
