"""What a program is made of: expressions, conditions and statements, each with its place in the text."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

from otr.programs.language.tokens import Place


@dataclass(slots=True)
class Number:
    """A constant."""

    value: float
    at: Place
    is_integer: bool = False  # as it is written: 1, not 1.0


@dataclass(slots=True)
class Name:
    """An input, a variable or a label."""

    text: str
    at: Place


@dataclass(slots=True)
class Chain:
    """A sum (``+ -``) or a product (``* /``): the operands after the first one come with their operators.

    One object a sum, not one an operator: a sum may have thousands of terms.
    """

    first: Expression
    rest: list[tuple[str, Expression, Place]]
    at: Place

    @property
    def is_sum(self) -> bool:
        """Whether this is a sum, not a product."""
        return self.rest[0][0] in "+-"


@dataclass(slots=True)
class Call:
    """A function of expressions."""

    function: str
    arguments: list[Expression]
    at: Place


@dataclass(slots=True)
class Choice:
    """`first` where the condition holds, else `second`."""

    condition: BooleanExpression
    first: Expression
    second: Expression
    at: Place


@dataclass(slots=True)
class Comparison:
    """Comparisons that all hold: ``operands[i] signs[i] operands[i + 1]``."""

    operands: list[Expression]
    signs: list[str]
    at: Place


@dataclass(slots=True)
class Logic:
    """All of the operands (`and`) or any of them (`or`)."""

    word: str
    operands: list[BooleanExpression]
    at: Place


@dataclass(slots=True)
class Negation:
    """That the operand does not hold."""

    operand: BooleanExpression
    at: Place


Expression: TypeAlias = Number | Name | Chain | Call | Choice
BooleanExpression: TypeAlias = Comparison | Logic | Negation


@dataclass(slots=True)
class Assign:
    """Give a value a name."""

    name: str
    value: Expression
    at: Place


@dataclass(slots=True)
class Return:
    """Answer with values, one an output."""

    values: list[Expression]
    at: Place
    is_bare: bool = False  # without the word


@dataclass(slots=True)
class If:
    """The block of the first condition that holds, else the last block, which may be missing."""

    at: Place
    branches: list[tuple[BooleanExpression, Statements]] = field(default_factory=list)
    otherwise: Statements | None = None
    always_returns: bool = False  # whichever condition holds


Statement: TypeAlias = Assign | Return | If
Statements: TypeAlias = list[Statement]


def always_returns(block: Statements) -> bool:
    """Return whether nothing after `block` is reached, whichever conditions hold."""
    if not block:
        return False
    last = block[-1]
    return last.always_returns if isinstance(last, If) else isinstance(last, Return)
