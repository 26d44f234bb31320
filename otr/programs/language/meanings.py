"""What means something else in C or Python than in this language is refused, with what to write instead."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise

from otr.programs.language.foreign import Translation
from otr.programs.language.syntax import (
    Assign,
    BooleanExpression,
    Call,
    Chain,
    Choice,
    Comparison,
    Expression,
    If,
    Logic,
    Name,
    Negation,
    Number,
    Return,
    Statement,
    Statements,
)
from otr.programs.language.tokens import Source, Token

_INT = (-(2**31), 2**31 - 1)
_FLOATING = frozenset(("float", "double", "void"))
_DIRECTIVE = re.compile(r"#(?:if|ifdef|ifndef|define|undef|elif|else)\b")
Part = Statement | Expression | BooleanExpression
Range = tuple[float, float]


def is_c(tokens: Sequence[Token], translation: Translation) -> bool:
    """Return whether a text is of C: by its function, or by semicolons without what C has not."""
    words = {token.word for token in tokens}
    return translation.language == "C" if translation.language else ";" in words and not words & {":", "then", "end"}


def check_tokens(source: Source, tokens: Sequence[Token], of_c: bool) -> None:
    """Refuse pieces of text of another meaning: Python's ``//``, octal and hexadecimal numbers, C's ``--`` and ``2u``.

    Raises:
        ProgramError: has the place, and what to write.
    """
    _check_comments(source, tokens, of_c)
    for token, after in pairwise(tokens):
        if token.kind == "number" and re.fullmatch("0[0-9]+", token.text):
            decimal = token.text.lstrip("0") or "0"
            raise source.error(f"{token.text} is octal in C; write {decimal}, or the decimal number meant", token.at)
        if token.at.line != after.at.line or token.end != after.at.column:
            continue
        if token.text == "0" and re.match("[xXbBoO]", after.text):
            raise source.error(f"0{after.text} is not decimal; write the decimal number", token.at)
        if of_c and token.kind == "number" and re.fullmatch("[uUlLfF]+", after.text):
            raise source.error(f"{token.text}{after.text} is one number in C; write it without {after.text}", token.at)
        if of_c and token.word in ("-", "+") and token.word == after.word:
            raise source.error(f"{token.word * 2} changes a variable in C; write the new value, as u = u + 1", token.at)


def _check_comments(source: Source, tokens: Sequence[Token], of_c: bool) -> None:
    """Refuse ``//`` where it may be Python's division, and comments that mean something to C."""
    has_braces = any(token.word == "{" for token in tokens)
    depths = [0]  # of brackets, before each token
    for token in tokens:
        depths.append(depths[-1] + (token.word in ("(", "[")) - (token.word in (")", "]")))
    for n, text, at in source.comments:
        if of_c and (_DIRECTIVE.match(text) or (text.startswith("//") and text.endswith("\\"))):
            raise source.error("C's preprocessor is not run here; write what it makes of this", at)
        if not n or text.startswith("#") or has_braces:
            continue
        last, after = tokens[n - 1], tokens[n]
        is_after_value = last.kind in ("number", "name") or last.word == ")"
        goes_on = last.at.line == at.line or depths[n] > 0
        ends_as_in_c = of_c and tokens[-2].word == ";" and (last.word == ")" or after.kind == "symbol")
        if is_after_value and goes_on and not ends_as_in_c:
            raise source.error(
                "// is a division that rounds down in Python, which is not affine; begin a comment with #", at
            )


def check_statements(
    source: Source, block: Statements, translation: Translation, labels: Collection[str], of_c: bool
) -> None:
    """Refuse statements of another meaning in C, such as ``1/2``, and answers that the text's function does not give.

    Raises:
        ProgramError: has the place, and what to write.
    """
    integers = dict.fromkeys(translation.integers, (0.0, 0.0))  # the least and the largest value of each
    for part in _all_parts(block):
        if isinstance(part, Assign) and part.name in integers and isinstance(part.value, Number):
            low, high = integers[part.name]
            integers[part.name] = min(low, part.value.value), max(high, part.value.value)
    for part in _all_parts(block):
        reason = _no_answer(part, translation, labels, of_c) or (of_c and _other_in_c(part, integers))
        if reason:
            raise source.error(reason, part.at)


def _no_answer(part: Part, translation: Translation, labels: Collection[str], of_c: bool) -> str:
    """Return why an answer is none in its function, or another there; "" where it is the same."""
    if not isinstance(part, Return):
        return ""
    if part.is_bare and (translation.language or of_c):
        return f"a value alone is no answer in {translation.language or 'C'}; write return before it"
    if translation.outputs:
        return f"this returns a value, and {translation.outputs}[...] has values, too; leave one out"
    if len(part.values) > 1 and of_c:
        return (
            "in C a comma leaves the last value alone; write y0 = ...; y1 = ...; for the outputs, "
            "or no semicolons if this is not C"
        )
    kind = translation.answers
    if not kind or _FLOATING & set(kind.split()):
        return ""
    value, (low, high) = part.values[0], _limits(kind)
    is_same = isinstance(value, Name) and (
        value.text in labels or (kind == "int" and value.text in translation.integers)
    )
    if is_same or _is_integer_in(value, low, high):
        return ""
    return f"C makes this a value of type {kind}; write double, or integers from {low} to {high}"


def _other_in_c(part: Part, integers: Mapping[str, Range]) -> str:
    """Return why C computes something else; "" where it does not."""
    if isinstance(part, Comparison) and len(part.signs) > 1:
        return "C compares the 0 or 1 of the first comparison with what follows; write a <= x && x <= b"
    if isinstance(part, Call) and part.function == "abs":
        return "abs rounds to an integer in C; write fabs"
    if isinstance(part, Chain) and _divides_integers(part, integers):
        return "C rounds the quotient of two integers; write one as 2.0, or the value"
    if isinstance(part, Chain) and _overflows(part, integers):
        return "this may overflow an int of C; write a number of it as 100000.0, or double"
    if isinstance(part, Assign) and part.name in integers and not _is_integer_in(part.value, *_INT):
        return f"{part.name!r} is an int, to which C rounds its value; write double {part.name}"
    return ""


def _limits(kind: str) -> tuple[int, int]:
    """Return the least and the largest integer that a type of C surely holds."""
    if kind == "int":
        return _INT
    if "bool" in kind.lower():
        return 0, 1
    sized = re.fullmatch(r"(u?)int(8|16|32|64)_t", kind)
    if sized is None:
        return 0, 127
    n = 2 ** (int(sized[2]) - (not sized[1]))
    return (0, n - 1) if sized[1] else (-n, n - 1)


def _is_integer_in(value: Expression, low: int, high: int) -> bool:
    return isinstance(value, Number) and value.value.is_integer() and low <= value.value <= high


def _divides_integers(chain: Chain, integers: Mapping[str, Range]) -> bool:
    """Return whether a product divides an integer of C's by another."""
    return any(
        operator == "/" for (operator, _, _), _ in zip(chain.rest, _integer_results(chain, integers), strict=False)
    )


def _overflows(chain: Chain, integers: Mapping[str, Range]) -> bool:
    """Return whether a result of integers of C's may be no int."""
    return any(not _INT[0] <= low <= high <= _INT[1] for low, high in _integer_results(chain, integers))


def _integer_results(chain: Chain, integers: Mapping[str, Range]) -> Iterator[Range]:
    """Yield the range of what each operator results in, from left to right, as long as C has integers."""
    so_far = _range(chain.first, integers)
    for operator, operand, _ in chain.rest:
        other = _range(operand, integers)
        if so_far is None or other is None:
            return
        if operator in "+-":
            low, high = other if operator == "+" else (-other[1], -other[0])
            so_far = so_far[0] + low, so_far[1] + high
        elif operator == "*":
            products = [a * b for a in so_far for b in other]
            so_far = min(products), max(products)
        yield so_far


def _range(value: Expression, integers: Mapping[str, Range]) -> Range | None:
    """Return the least and the largest value of an integer of C's, an expression of integers alone; else None."""
    if isinstance(value, Number):
        return (value.value, value.value) if value.is_integer else None
    if isinstance(value, Name):
        return integers.get(value.text)
    if isinstance(value, Chain):
        results = [*_integer_results(value, integers)]
        return results[-1] if len(results) == len(value.rest) else None
    if not isinstance(value, Call) or value.function not in ("max", "min"):
        return None
    ranges = [each for argument in value.arguments if (each := _range(argument, integers))]
    if len(ranges) < len(value.arguments):
        return None
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def _all_parts(block: Statements) -> Iterator[Part]:
    """Yield the statements of a block and all that they are made of, in the order of the text."""
    pending: list[Part] = [*reversed(block)]
    while pending:
        part = pending.pop()
        yield part
        pending += reversed([*_parts(part)])


def _parts(part: Part) -> Iterator[Part]:
    """Yield what a statement or an expression is made of, in the order of the text."""
    if isinstance(part, Assign):
        yield part.value
    elif isinstance(part, Return):
        yield from part.values
    elif isinstance(part, If):
        for condition, block in part.branches:
            yield condition
            yield from block
        yield from part.otherwise or ()
    elif isinstance(part, Chain):
        yield part.first
        yield from (operand for _, operand, _ in part.rest)
    elif isinstance(part, Call):
        yield from part.arguments
    elif isinstance(part, Choice):
        yield from (part.condition, part.first, part.second)
    elif isinstance(part, Comparison | Logic):
        yield from part.operands
    elif isinstance(part, Negation):
        yield part.operand
