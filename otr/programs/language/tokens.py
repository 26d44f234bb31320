"""From a program's text to its tokens."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from otr.errors import ProgramError

KEYWORDS = frozenset(("if", "then", "else", "elif", "end", "return", "and", "or", "not"))
_OTHER_SPELLINGS = {
    "elseif": "elif", "elsif": "elif", "endif": "end",
    "≤": "<=", "≥": ">=", "≠": "!=", "−": "-", "–": "-", "×": "*", "·": "*", "⋅": "*", "÷": "/", "**": "^",
    "&&": "and", "∧": "and", "||": "or", "∨": "or", "!": "not", "¬": "not", ":=": "=",
}  # fmt: skip
_WORD = r"[^\W\d]\w*"
_SYMBOLS = r"<=|>=|==|!=|:=|\*\*|&&|\|\||[-+*/^<>=(){}\[\],;:!≤≥≠−–×·⋅÷∧∨¬]"
_NUMBER = r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_ESCAPE = r"\\(?:u\{([0-9a-f]{1,5}|10[0-9a-f]{4})\}|[\\`])"
QUOTED = r"`(?:[^\\`]|\\.)*`"


@dataclass(frozen=True, slots=True)
class Place:
    """A place in the text: line and column, counted from 1."""

    line: int
    column: int


@dataclass(frozen=True, slots=True)
class Token:
    """A piece of the text; one of kind `stop` is the end of it."""

    kind: Literal["number", "name", "keyword", "symbol", "stop"]
    text: str  # as written, or the first of several spellings
    at: Place  # where it begins
    end: int  # the column after it
    indent: int  # the column of the first token on its line

    @property
    def is_first(self) -> bool:
        """Whether it is the first token on its line."""
        return self.at.column == self.indent

    @property
    def word(self) -> str:
        """The text of a keyword or symbol; "" of a name, which may hold any text, and of all else."""
        return self.text if self.kind in ("keyword", "symbol") else ""

    def __str__(self) -> str:
        return "the end of the text" if self.kind == "stop" else repr(self.text)


class Source:
    """A program's lines, which errors show, and its comments once it is in tokens."""

    def __init__(self, text: str) -> None:
        self.lines = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")
        self.comments: list[tuple[int, str, Place]] = []  # the number of tokens before each, its text, its place

    def error(self, reason: str, at: Place) -> ProgramError:
        """Return the error for a place."""
        return ProgramError(reason, at.line, at.column, self.lines[at.line - 1])


def written(name: str) -> str:
    """Return a name as a program's text has it: of words as it is, any other between backquotes.

    Between these a backslash escapes a backslash or a backquote, and what does not print is ``\\u{code}``.
    """
    if _is_of_words(name):
        return name
    characters = (f"\\{c}" if c in "\\`" else c if c.isprintable() else f"\\u{{{ord(c):x}}}" for c in name)
    return f"`{''.join(characters)}`"


def _unquoted(text: str) -> str:
    """Return the name between backquotes."""
    return re.sub(_ESCAPE, lambda match: chr(int(match[1], 16)) if match[1] else match[0][1], text[1:-1])


def _is_of_words(name: str) -> bool:
    """Return whether a name is words with single spaces between them, none of which means something to the language.

    Two adjacent words are no expression, so such a name is never mistaken for one.
    """
    words = name.split(" ")
    is_of_words = re.fullmatch(_WORD, words[0]) and all(re.fullmatch(r"\w+", word) for word in words)
    return bool(is_of_words) and not any(_spelled(word).lower() in KEYWORDS for word in words)


def _spelled(text: str) -> str:
    """Return the first of several spellings of a word or symbol."""
    return _OTHER_SPELLINGS.get(text.lower(), text)


def tokenize(source: Source, names: Sequence[str], functions: Collection[str]) -> list[Token]:
    """Return the tokens of a program, the last of kind `stop`.

    One of the `names` that is no word, such as ``left contact``, is found wherever it occurs as a whole, and the
    longest of several is taken; but where its text is an expression of other names, such as ``x - 1``, it is that, and
    the name is found between backquotes alone. Raise ProgramError where a character belongs to nothing.
    """
    pattern = _pattern(_found_bare(names, functions))
    tokens: list[Token] = []
    for number, line in enumerate(source.lines, start=1):
        column, indent = 0, 0
        while column < len(line):
            at = Place(number, column + 1)
            match = pattern.match(line, column)
            if match is None:
                hint = "; write a if ... else b" if line[column] == "?" else ""
                raise source.error(f"the character {line[column]!r} has no meaning here{hint}", at)
            if match.lastgroup == "comment":
                source.comments.append((len(tokens), match.group(), at))
            elif match.lastgroup != "space":
                indent = indent or column + 1
                tokens.append(_token(match, at, indent))
            column = match.end()
    last = tokens[-1] if tokens else None
    at = Place(last.at.line, last.end) if last else Place(1, 1)
    return [*tokens, Token("stop", "", at, at.column, 0)]


def _found_bare(names: Sequence[str], functions: Collection[str]) -> list[str]:
    """Return the names that are no words and are found without backquotes.

    These are those of several words, and those that hold what no expression does: a character without a meaning, or a
    word that is no other name's, none of the language's and no default name of an output.
    """
    usual = _pattern([])
    words = [_words_of(name, usual) for name in names]
    n_names = Counter(word for own in words for word in own or ())

    def is_known(word: str) -> bool:
        is_default = re.fullmatch(r"y[0-9]+", word) is not None
        return n_names[word] > 1 or word in functions or is_default or _spelled(word).lower() in KEYWORDS

    return [
        name
        for name, own in zip(names, words, strict=True)
        if not re.fullmatch(_WORD, name)
        and "`" not in name
        and (_is_of_words(name) or own is None or not all(map(is_known, own)))
    ]


def _words_of(name: str, usual: re.Pattern[str]) -> set[str] | None:
    """Return the words in a name; None where it holds a character that has no meaning in an expression."""
    pieces = list(usual.finditer(name))
    if sum(len(piece.group()) for piece in pieces) < len(name) or any(p.lastgroup == "comment" for p in pieces):
        return None
    return {piece.group() for piece in pieces if piece.lastgroup == "word"}


def _pattern(odd_names: list[str]) -> re.Pattern[str]:
    alternatives = [
        re.escape(name) + (r"(?!\w)" if re.match(r"\w", name[-1]) else "")
        for name in sorted(odd_names, key=len, reverse=True)
    ]
    odd = [f"(?P<odd>{'|'.join(alternatives)})"] if alternatives else []
    quoted = f"(?P<quoted>{QUOTED})"
    usual = [
        r"(?P<space>\s+)",
        r"(?P<comment>(?:#|//).*)",
        f"(?P<number>{_NUMBER})",
        f"(?P<word>{_WORD})",
        f"(?P<symbol>{_SYMBOLS})",
    ]
    return re.compile("|".join((quoted, *odd, *usual)))


def _token(match: re.Match[str], at: Place, indent: int) -> Token:
    text, end = match.group(), match.end() + 1
    if match.lastgroup == "odd":
        return Token("name", text, at, end, indent)
    if match.lastgroup == "quoted":
        return Token("name", _unquoted(text), at, end, indent)
    if match.lastgroup == "number":
        return Token("number", text, at, end, indent)
    usual = _spelled(text)
    if usual.lower() in KEYWORDS:
        return Token("keyword", usual.lower(), at, end, indent)
    return Token("name" if match.lastgroup == "word" else "symbol", usual, at, end, indent)


def check_indentation(source: Source, tokens: Sequence[Token]) -> None:
    """Refuse tabs mixed with spaces: which line is indented more would depend on the reader's editor.

    Raises:
        ProgramError: has the line, and another that is indented otherwise.
    """
    indented_by: dict[str, int] = {}  # the first line that each character indents
    for token in tokens:
        line, n = token.at.line, token.indent - 1 if token.is_first else 0
        margin = source.lines[line - 1][:n]
        for character in dict.fromkeys(margin):  # there may be thousands of spaces
            indented_by.setdefault(character, line)
        if len(indented_by) > 1:
            other = next(first for character, first in indented_by.items() if first != line or character != margin[0])
            raise source.error(
                f"tabs and spaces indent this program's lines (see line {other}); use one of them", Place(line, 1)
            )
