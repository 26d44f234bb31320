"""From tokens to expressions and conditions, by precedence climbing."""

from __future__ import annotations

from otr.programs.language.cursor import Cursor
from otr.programs.language.scope import FUNCTIONS, Scope
from otr.programs.language.syntax import (
    BooleanExpression,
    Call,
    Chain,
    Choice,
    Comparison,
    Expression,
    Logic,
    Name,
    Negation,
    Number,
)
from otr.programs.language.tokens import Place, Token

COMPARISONS = ("<=", ">=", "<", ">", "==", "!=")
OR, AND, NOT, COMPARE, SUM, PRODUCT, SIGN = range(1, 8)  # the higher, the closer the operands
RANKS = {"or": OR, "and": AND, **dict.fromkeys(COMPARISONS, COMPARE), "+": SUM, "-": SUM, "*": PRODUCT, "/": PRODUCT}
Node = Expression | BooleanExpression


class ExpressionReader:
    """Reads expressions; whether each is a number or a condition, as its place requires, is checked at once."""

    def __init__(self, cursor: Cursor, scope: Scope) -> None:
        self._cursor, self._scope = cursor, scope

    def expression(self) -> Expression:
        """Read a number-valued expression: ``a``, ``a if condition else b`` or ``if condition then a else b``."""
        return self._number(self._node())

    def condition(self) -> BooleanExpression:
        """Read a condition."""
        return self._condition(self._chain(OR))

    def _choice_by_if(self) -> Choice:
        cursor = self._cursor
        at = cursor.take().at
        condition = self.condition()
        if not cursor.is_next("then", ":"):
            raise cursor.error(f"expected 'then' after the condition, found {cursor.found}")
        cursor.take()
        with cursor.nested():
            first = self.expression()
        if not cursor.is_next("elif"):
            return Choice(condition, first, self._other_value(), at)
        with cursor.nested():
            return Choice(condition, first, self._choice_by_if(), at)

    def _node(self) -> Node:
        """Read an expression or a condition."""
        cursor = self._cursor
        if cursor.is_next("if"):
            return self._choice_by_if()
        value = self._chain(OR)
        if not cursor.is_next("if"):
            return value
        at = cursor.take().at
        return Choice(self.condition(), self._number(value), self._other_value(), at)

    def _other_value(self) -> Expression:
        self._cursor.expect("else", "after the condition, for the other value")
        with self._cursor.nested():
            return self.expression()

    def _chain(self, lowest: int) -> Node:
        """Read operands and the operators between them that bind at least as closely as `lowest`."""
        cursor = self._cursor
        left = self._prefix()
        while True:
            token = cursor.here
            if self._is_factor(token):
                if lowest > PRODUCT:
                    return left
                self._check_divisor(left, token)
                left = self._joined(left, "*", self._right_hand(SIGN), token.at)
                continue
            rank = RANKS.get(token.word, 0)
            if token.word == "^":
                raise cursor.error("powers are not affine; write constants as numbers, such as 1e-3")
            if rank < max(lowest, OR):
                return left
            left = self._comparison(left) if rank == COMPARE else self._operation(left, rank)

    def _is_factor(self, token: Token) -> bool:
        """Return whether `token` is multiplied by the number right before it, as in ``2 x`` and ``2 (x + 1)``."""
        last = self._cursor.last
        if last.kind != "number" or last.at.line != token.at.line:
            return False
        return token.kind == "name" or token.word == "("

    def _check_divisor(self, left: Node, token: Token) -> None:
        if isinstance(left, Chain) and left.rest[-1][0] == "/":
            raise self._cursor.error(
                f"is {token} divided by, too? Write a / b * {token.text} or a / (b * {token.text})", token.at
            )

    def _operation(self, left: Node, rank: int) -> Node:
        token = self._cursor.take()
        right = self._right_hand(rank + 1)
        if rank > COMPARE:
            return self._joined(left, token.text, right, token.at)
        condition, operand = self._condition(left), self._condition(right)
        if isinstance(condition, Logic) and condition.word == token.text:
            condition.operands.append(operand)
            return condition
        return Logic(token.text, [condition, operand], token.at)

    def _joined(self, left: Node, operator: str, right: Node, at: Place) -> Chain:
        """Return a sum or product of two operands, with the left one taken into it where that is one already."""
        first, second = self._number(left), self._number(right)
        if isinstance(first, Chain) and first.is_sum == (operator in "+-"):
            first.rest.append((operator, second, at))
            return first
        return Chain(first, [(operator, second, at)], first.at)

    def _comparison(self, first: Node) -> Comparison:
        cursor = self._cursor
        at = cursor.here.at
        operands, signs = [self._number(first)], []
        while cursor.is_next(*COMPARISONS):
            signs.append(cursor.take().text)
            operands.append(self._number(self._right_hand(SUM)))
        return Comparison(operands, signs, at)

    def _right_hand(self, lowest: int) -> Node:
        """Read what is on the right of an operator: a level deeper, because the reader calls itself."""
        with self._cursor.nested():
            return self._chain(lowest)

    def _prefix(self) -> Node:
        cursor = self._cursor
        token = cursor.here
        if token.word == "not":
            cursor.take()
            with cursor.nested():
                return Negation(self._negated(token), token.at)
        if token.word in ("-", "+"):
            cursor.take()
            with cursor.nested():
                operand = self._number(self._chain(SIGN))
            if token.word == "+":
                return operand
            if isinstance(operand, Number):
                return Number(-operand.value, token.at, operand.is_integer)
            return Chain(Number(-1.0, token.at, is_integer=True), [("*", operand, token.at)], token.at)
        return self._operand()

    def _negated(self, token: Token) -> BooleanExpression:
        """Read the operand of a `not`, or of a `!`, which binds as closely as a sign in C."""
        cursor = self._cursor
        if cursor.source.lines[token.at.line - 1][token.at.column - 1] != "!":
            return self._condition(self._chain(NOT))
        operand = self._chain(SIGN)
        if cursor.is_next(*COMPARISONS):
            raise cursor.error(
                "in C '!' belongs to what is right after it; write !(...) around the comparison", token.at
            )
        return self._condition(operand)

    def _operand(self) -> Node:
        cursor = self._cursor
        token = cursor.here
        if token.kind == "number":
            cursor.take()
            value = float(token.text)
            if value == float("inf"):
                raise cursor.error(f"{token.text} is larger than a float64 can hold", token.at)
            return Number(value, token.at, token.text.isdigit())
        if token.kind == "name":
            if cursor.is_after("("):
                return self._call()
            cursor.take()
            self._scope.use(token.text, token.at)
            return Name(token.text, token.at)
        if token.word == "(":
            with cursor.bracket():
                cursor.take()
                inner = self._node()
                cursor.expect(")", "to close the bracket of " + _where(token))
            return inner
        raise cursor.error(f"expected a number, a name or '(', found {cursor.found}")

    def _call(self) -> Call:
        cursor = self._cursor
        name = cursor.take()
        self._scope.check_function(name.text, name.at)
        with cursor.bracket():
            cursor.take()
            arguments = [self.expression()]
            while cursor.is_next(","):
                cursor.take()
                if cursor.is_next(")"):  # a comma at the end
                    break
                arguments.append(self.expression())
            cursor.expect(")", f"to close the bracket of {name.text}")
        least, most = FUNCTIONS[name.text]
        if len(arguments) < least or (most is not None and len(arguments) > most):
            raise cursor.error(f"{name.text} takes {least} argument{'s' * (least > 1)}, got {len(arguments)}", name.at)
        return Call(name.text, arguments, name.at)

    def _number(self, node: Node) -> Expression:
        if isinstance(node, Comparison | Logic | Negation):
            raise self._cursor.error(
                "this is a condition where a number was expected; is 'then' missing, or '... if ... else ...'?",
                node.at,
            )
        return node

    def _condition(self, node: Node) -> BooleanExpression:
        if isinstance(node, Comparison | Logic | Negation):
            return node
        if self._cursor.is_next("="):
            raise self._cursor.error("'=' gives a name a value; to compare, write '==' or '<='")
        raise self._cursor.error("this is a number where a condition was expected; compare it, as ... > 0", node.at)


def _where(token: Token) -> str:
    return f"line {token.at.line}, column {token.at.column}"
