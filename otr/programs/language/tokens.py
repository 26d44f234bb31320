"""From a program's text to its tokens."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from otr.errors import ProgramError

__all__ = ["KEYWORDS", "Place", "Source", "Token", "is_plain", "tokenize"]

KEYWORDS = frozenset(("if", "then", "else", "elif", "end", "return", "and", "or", "not"))
_OTHER_SPELLINGS = {
    "elseif": "elif", "elsif": "elif", "endif": "end",
    "≤": "<=", "≥": ">=", "≠": "!=", "−": "-", "–": "-", "×": "*", "·": "*", "⋅": "*", "÷": "/", "**": "^",
    "&&": "and", "∧": "and", "||": "or", "∨": "or", "!": "not", "¬": "not", ":=": "=",
}  # fmt: skip
_WORD = r"[^\W\d]\w*"
_SYMBOLS = r"<=|>=|==|!=|:=|\*\*|&&|\|\||[-+*/^<>=(){}\[\],;:!≤≥≠−–×·⋅÷∧∨¬]"
_NUMBER = r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"


@dataclass(frozen=True, slots=True)
class Place:
    """A place in the text: line and column, counted from 1."""

    line: int
    column: int


@dataclass(frozen=True, slots=True)
class Token:
    """A piece of the text.

    Attributes:
        kind: what it is; `stop` is the end of the text.
        text: as written, or the first of several spellings.
        at: where it begins.
        end: the column after it.
        indent: the column of the first token on its line.
    """

    kind: Literal["number", "name", "keyword", "symbol", "stop"]
    text: str
    at: Place
    end: int
    indent: int

    @property
    def is_first(self) -> bool:
        """Whether it is the first token on its line."""
        return self.at.column == self.indent

    def __str__(self) -> str:
        return "the end of the text" if self.kind == "stop" else repr(self.text)


class Source:
    """A program's lines, which errors show."""

    def __init__(self, text: str) -> None:
        self.lines = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")

    def error(self, reason: str, at: Place) -> ProgramError:
        """Return the error for a place."""
        return ProgramError(reason, at.line, at.column, self.lines[at.line - 1])


def is_plain(name: str) -> bool:
    """Return whether a name is a word: letters, digits and underscores, the first no digit."""
    return re.fullmatch(_WORD, name) is not None


def tokenize(source: Source, names: Iterable[str]) -> list[Token]:
    """Return the tokens of a program, the last of kind `stop`.

    Args:
        source: the text.
        names: names that may occur. One that is not plain, such as ``left contact``, is found wherever it stands as a
            whole, and the longest of several is taken.

    Raises:
        ProgramError: a character belongs to nothing, or tabs and spaces indent lines of one program.
    """
    pattern = _pattern([name for name in names if not is_plain(name)])
    tokens: list[Token] = []
    indented_by: dict[str, int] = {}  # the first line that each character indents
    for number, line in enumerate(source.lines, start=1):
        column, indent = 0, 0
        while column < len(line):
            at = Place(number, column + 1)
            match = pattern.match(line, column)
            if match is None:
                raise source.error(f"the character {line[column]!r} has no meaning here", at)
            if match.lastgroup not in ("space", "comment"):
                if not indent:
                    indent = column + 1
                    _check_indentation(source, line[:column], number, indented_by)
                tokens.append(_token(match, at, indent))
            column = match.end()
    last = tokens[-1] if tokens else None
    at = Place(last.at.line, last.end) if last else Place(1, 1)
    return [*tokens, Token("stop", "", at, at.column, 0)]


def _pattern(odd_names: list[str]) -> re.Pattern[str]:
    alternatives = [
        re.escape(name) + (r"(?!\w)" if re.match(r"\w", name[-1]) else "")
        for name in sorted(odd_names, key=len, reverse=True)
    ]
    odd = [f"(?P<odd>{'|'.join(alternatives)})"] if alternatives else []
    usual = [
        r"(?P<space>\s+)",
        r"(?P<comment>(?:#|//).*)",
        f"(?P<number>{_NUMBER})",
        f"(?P<word>{_WORD})",
        f"(?P<symbol>{_SYMBOLS})",
    ]
    return re.compile("|".join((*odd, *usual)))


def _token(match: re.Match[str], at: Place, indent: int) -> Token:
    text, end = match.group(), match.end() + 1
    if match.lastgroup == "odd":
        return Token("name", text, at, end, indent)
    if match.lastgroup == "number":
        return Token("number", text, at, end, indent)
    usual = _OTHER_SPELLINGS.get(text.lower(), text)
    if usual.lower() in KEYWORDS:
        return Token("keyword", usual.lower(), at, end, indent)
    return Token("name" if match.lastgroup == "word" else "symbol", usual, at, end, indent)


def _check_indentation(source: Source, margin: str, line: int, indented_by: dict[str, int]) -> None:
    """Refuse tabs beside spaces: which line is indented more would depend on the reader's editor."""
    for character in margin:
        indented_by.setdefault(character, line)
    if len(indented_by) > 1:
        other = next(first for character, first in indented_by.items() if first != line or character != margin[0])
        raise source.error(
            f"tabs and spaces indent this program's lines (see line {other}); use one of them", Place(line, 1)
        )
