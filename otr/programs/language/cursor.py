"""The position in a program that is being read, and which lines belong together."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from otr.errors import ProgramError
from otr.programs.language.tokens import Place, Source, Token

# Of brackets and operators whose right-hand side is being read, in one statement. A level takes at most eight of the
# 1,000 calls within calls that Python allows, when it is read and when it is evaluated. Blocks take none (`result_of`).
MAX_NESTING = 100


class Cursor:
    """A position among the tokens.

    A statement ends with its line. It goes on where a bracket is open or the next line is indented more than the one
    that the statement began on.
    """

    def __init__(self, source: Source, tokens: list[Token]) -> None:
        """Begin before the first of the tokens, the last of which is of kind `stop`."""
        self.source = source
        self._tokens = tokens
        self._next = 0
        self._first_of_statement = 0
        self._brackets = 0
        self._nesting = 0

    @property
    def token(self) -> Token:
        """The next token, on whatever line."""
        return self._tokens[self._next]

    @property
    def here(self) -> Token:
        """The next token if it belongs to the statement under way, else one of kind `stop`."""
        token, first = self.token, self._tokens[self._first_of_statement]
        is_later = token.is_first and self._next > self._first_of_statement and not self._brackets
        if is_later and token.indent <= first.indent:
            return Token("stop", "", Place(self.last.at.line, self.last.end), self.last.end, 0)
        return token

    @property
    def is_at_end(self) -> bool:
        """Whether nothing is left."""
        return self.token.kind == "stop"

    @property
    def last(self) -> Token:
        """The token that was taken last."""
        return self._tokens[self._next - 1]

    def begin_statement(self) -> Token:
        """Return the next token and take it as the first of a statement."""
        self._first_of_statement = self._next
        return self.token

    def take(self) -> Token:
        """Return the next token and go on."""
        token = self.token
        self._next += token.kind != "stop"
        return token

    def is_next(self, *texts: str) -> bool:
        """Return whether the next token of the statement is one of these symbols or keywords."""
        return self.here.word in texts

    def is_after(self, text: str) -> bool:
        """Return whether the token after the next one is this symbol, on the same line."""
        after = self._tokens[min(self._next + 1, len(self._tokens) - 1)]
        return after.word == text and after.at.line == self.token.at.line

    def expect(self, text: str, why: str) -> Token:
        """Take a symbol or keyword of the statement; `why` says what it is for."""
        if not self.is_next(text):
            raise self.error(f"expected {text!r} {why}, found {self.found}")
        return self.take()

    @property
    def found(self) -> str:
        """The next token of the statement in words, for errors."""
        return "the end of the line" if self.here.kind == "stop" and self.token.kind != "stop" else str(self.here)

    def error(self, reason: str, at: Place | None = None) -> ProgramError:
        """Return the error for a place, by default the next token of the statement."""
        return self.source.error(reason, at or self.here.at)

    @contextmanager
    def bracket(self) -> Iterator[None]:
        """Read what is in brackets, where ends of lines have no meaning."""
        with self.nested():
            self._brackets += 1
            yield
        self._brackets -= 1

    @contextmanager
    def nested(self) -> Iterator[None]:
        """Read what is one level deeper; raise ProgramError if that is too deep."""
        self._nesting += 1
        if self._nesting > MAX_NESTING:
            raise self.error(
                f"more than {MAX_NESTING} brackets and operators within each other; give a part a name of its own"
            )
        yield
        self._nesting -= 1

    def opens_tuple(self) -> bool:
        """Return whether the next token opens round brackets with a comma directly in them."""
        depth = 0
        for token in self._tokens[self._next :]:
            if token.word in tuple("([{"):
                depth += 1
            elif token.word in tuple(")]}"):
                depth -= 1
                if depth == 0:
                    return False
            elif depth == 1 and token.word == ",":
                return True
        return False
