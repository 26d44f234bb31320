"""Errors that the library raises; each message says what was wrong, where, and what to do."""

from fractions import Fraction


class OtrError(Exception):
    """Base of every error that is particular to this library."""


class InvalidNetworkError(OtrError, ValueError):
    """A network's shapes or numbers make no sense, or it is of a kind that cannot be imported."""


class InvalidTreeError(OtrError, ValueError):
    """A tree's arrays break an invariant of `ObliqueTree`."""


class TreeTooLargeError(OtrError):
    """The tree asked for has more leaves than the caller allows."""


class TimeLimitError(TreeTooLargeError):
    """A call took the seconds that the caller allows (`max_seconds`); the message says what it had reached."""


class MissingExtraError(OtrError, ImportError):
    """A package is not installed that one of otr's extras brings, such as ``otr[learn]``; the message names both."""


class CertificateError(OtrError):
    """A tree and a network are not the same function, or a certificate does not prove that they are.

    Attributes:
        leaf: of the tree, where that is; None where it is of no single one.
        state: (d,) fractions, a point of that leaf where the two differ, checked in exact arithmetic; None where none
            is known.
    """

    def __init__(self, message: str, leaf: int | None = None, state: tuple[Fraction, ...] | None = None) -> None:
        """Keep all arguments as the exception's own, so that it can be pickled."""
        super().__init__(message, leaf, state)
        self.leaf, self.state = leaf, state

    def __str__(self) -> str:
        return str(self.args[0])


class ArtefactError(OtrError):
    """A file is missing, truncated, changed since it was written, or of another schema."""


class DivergedError(OtrError, ArithmeticError):
    """Training ended in numbers that are not finite."""


class ProgramError(OtrError, ValueError):
    """A program's text cannot be read; shows the place.

    Attributes:
        reason: what is wrong and what to do, without the place.
        line, column: the place, counted from 1, in characters.
        source_line: the text of that line.
    """

    def __init__(self, reason: str, line: int, column: int, source_line: str) -> None:
        """Keep all arguments as the exception's own, so that it can be pickled."""
        super().__init__(reason, line, column, source_line)
        self.reason, self.line, self.column, self.source_line = reason, line, column, source_line

    @property
    def excerpt(self) -> str:
        """The line, and below it a caret under the place."""
        margin = "".join("\t" if character == "\t" else " " for character in self.source_line[: self.column - 1])
        return f"    {self.source_line}\n    {margin}^"

    def __str__(self) -> str:
        return f"line {self.line}, column {self.column}: {self.reason}\n{self.excerpt}"
