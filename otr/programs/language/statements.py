"""From tokens to statements and blocks."""

from __future__ import annotations

from otr.programs.language.cursor import Cursor
from otr.programs.language.expressions import ExpressionReader
from otr.programs.language.nesting import Steps, result_of
from otr.programs.language.scope import Scope
from otr.programs.language.syntax import Assign, Expression, If, Return, Statement, Statements, always_returns
from otr.programs.language.tokens import Token


def read_program(cursor: Cursor, scope: Scope) -> Statements:
    """Return the statements of a program; ProgramError names what was expected and what was found."""
    reader = _StatementReader(cursor, scope)
    if cursor.is_at_end:
        raise cursor.error("the program is empty")
    block = result_of(reader.lines(cursor.token.indent))
    if not cursor.is_at_end:
        raise reader.unexpected()
    return block


class _StatementReader:
    """Reads statements in steps (`result_of`), as blocks may be nested to any depth."""

    def __init__(self, cursor: Cursor, scope: Scope) -> None:
        self._cursor, self._scope = cursor, scope
        self._expressions = ExpressionReader(cursor, scope)

    def lines(self, indent: int) -> Steps[Statements]:
        """Read the statements of a block whose lines are indented alike."""
        cursor, block = self._cursor, Statements()
        while not self._is_at_end() and (not cursor.token.is_first or cursor.token.indent == indent):
            yield self._add_to(block)
        if cursor.token.is_first and cursor.token.indent > indent and not self._is_at_end():
            raise self.unexpected()
        return block

    def unexpected(self) -> Exception:
        """Return the error for a token that fits nowhere."""
        token = self._cursor.token
        if token.word in ("else", "elif", "end"):
            return self._cursor.error(f"{token} without an 'if' that it could belong to", token.at)
        if token.is_first and token.word != "}":
            return self._cursor.error("this line is indented unlike those around it", token.at)
        return self._cursor.error(f"unexpected {token}", token.at)

    def _is_at_end(self) -> bool:
        token = self._cursor.token
        return token.kind == "stop" or (token.word in ("else", "elif", "end", "}"))

    def _add_to(self, block: Statements) -> Steps[None]:
        """Read a statement, and the semicolons after it."""
        cursor = self._cursor
        token = cursor.token
        if always_returns(block):
            line = block[-1].at.line
            raise cursor.error(f"nothing reaches this: line {line} has answered", token.at)
        block.append((yield self._statement()))
        if self._cursor.token.word == ";":
            while cursor.token.word == ";":
                cursor.take()
        elif not (cursor.token.is_first or self._is_at_end() or cursor.last.word in ("}", "end", "if", ";")):
            is_factor = cursor.token.kind == "name" and (cursor.last.kind == "name" or cursor.last.word == ")")
            hint = "; write * for a product" if is_factor else ""
            raise cursor.error(f"unexpected {cursor.token} after a statement{hint}", cursor.token.at)

    def _statement(self) -> Steps[Statement]:
        cursor = self._cursor
        token = cursor.begin_statement()
        if token.word == "if":
            statement: If = yield self._if()
            return statement
        if token.word == "return":
            cursor.take()
            return Return(self._values(), token.at)
        if token.kind == "name" and cursor.is_after("="):
            cursor.take()
            cursor.take()
            value = self._expressions.expression()
            self._scope.assign(token.text, token.at)
            return Assign(token.text, value, token.at)
        return Return(self._values(), token.at, is_bare=True)

    def _values(self) -> list[Expression]:
        """Read the values of an answer: one, or several with commas between them, with or without brackets."""
        cursor = self._cursor
        is_list = cursor.is_next("[") or (cursor.is_next("(") and cursor.opens_tuple())
        if not is_list:
            return self._listed()
        with cursor.bracket():
            opening = cursor.take()
            values = self._listed()
            cursor.expect("]" if opening.text == "[" else ")", "to close the list of values")
        return values

    def _listed(self) -> list[Expression]:
        values = [self._expressions.expression()]
        while self._cursor.is_next(","):
            self._cursor.take()
            if self._cursor.is_next("]", ")") or self._cursor.here.kind == "stop":  # a comma at the end
                break
            values.append(self._expressions.expression())
        return values

    def _if(self) -> Steps[If]:
        cursor = self._cursor
        first = cursor.take()
        statement = If(first.at)
        is_c_like = yield self._add_branch(statement, first)
        while self._continues(first, "elif") or self._continues(first, "else"):
            word = cursor.begin_statement()
            cursor.take()
            if word.text == "else" and not self._is_word_on_line("if", word):
                is_announced = cursor.token.word in (":", "then")
                if is_announced:
                    cursor.take()
                statement.otherwise = yield self._block(word, is_announced or not is_c_like)
                break
            if word.text == "else":
                cursor.take()
            yield self._add_branch(statement, word)
        if self._continues(first, "end"):
            end = cursor.take()
            if self._is_word_on_line("if", end):
                cursor.take()
        statement.always_returns = statement.otherwise is not None and all(
            map(always_returns, (statement.otherwise, *(block for _, block in statement.branches)))
        )
        return statement

    def _is_word_on_line(self, word: str, other: Token) -> bool:
        """Return whether a keyword comes next, on the line of the token before it."""
        token = self._cursor.token
        return token.word == word and token.at.line == other.at.line

    def _continues(self, first: Token, word: str) -> bool:
        """Return whether `word` comes next and belongs to the `if` at `first`, as far as indentation shows it."""
        token = self._cursor.token
        is_word = token.word == word
        return is_word and (not token.is_first or token.indent >= first.indent)

    def _add_branch(self, statement: If, first: Token) -> Steps[bool]:
        """Read a condition and its block; return whether it is as in C, without a word or colon between the two."""
        cursor = self._cursor
        condition = self._expressions.condition()
        is_announced = cursor.token.word in ("then", ":")
        if is_announced:
            cursor.take()
        elif not self._starts_block():
            raise cursor.error(f"expected 'then' or ':' after the condition, found {cursor.found}")
        statement.branches.append((condition, (yield self._block(first, is_announced))))
        return not is_announced

    def _starts_block(self) -> bool:
        """Return whether braces follow, or a statement after round brackets, as in ``if (x > 0) return 1;``."""
        token = self._cursor.token
        starts = token.kind == "name" or token.word in ("return", "if")
        return token.word == "{" or (starts and self._cursor.last.word == ")")

    def _block(self, owner: Token, is_announced: bool) -> Steps[Statements]:
        """Read the block of an `if`, `elif` or `else`, its owner.

        Unless a colon or a word announced the block, it is in braces or one statement, as in C.
        """
        cursor = self._cursor
        with self._scope.block():
            token = cursor.token
            if token.word == "{":
                steps = self._braces()
            elif self._is_at_end():
                raise cursor.error(f"expected a statement for {owner}, found {token}", token.at)
            elif not is_announced:
                steps = self._one()
            elif not token.is_first:
                steps = self._same_line()
            else:
                steps = self.lines(token.indent) if token.indent > owner.indent else self._unindented(owner)
            block: Statements = yield steps
            return block

    def _one(self) -> Steps[Statements]:
        block = Statements()
        yield self._add_to(block)
        inner, token = block[0], self._cursor.token
        if isinstance(inner, If) and inner.otherwise is None and token.word in ("else", "elif"):
            raise self._cursor.error(
                f"in C this {token.text} belongs to the 'if' of line {inner.at.line}; put braces around one of them",
                token.at,
            )
        return block

    def _braces(self) -> Steps[Statements]:
        cursor, block = self._cursor, Statements()
        opening = cursor.take()
        while not self._is_at_end():
            yield self._add_to(block)
        if cursor.token.word != "}":
            raise cursor.error(
                f"expected '}}' for the brace of line {opening.at.line}, found {cursor.token}", cursor.token.at
            )
        if not block:
            raise cursor.error("expected a statement between the braces", cursor.token.at)
        cursor.take()
        return block

    def _same_line(self) -> Steps[Statements]:
        block = Statements()
        while not self._is_at_end() and not (block and self._cursor.token.is_first):
            yield self._add_to(block)
        return block

    def _unindented(self, owner: Token) -> Steps[Statements]:
        """Read a block that is indented no more than its owner: its end is an answer, `else`, `elif` or `end`."""
        cursor, block = self._cursor, Statements()
        while not self._is_at_end() and not always_returns(block):
            yield self._add_to(block)
        if not always_returns(block) and cursor.token.word not in ("else", "elif", "end"):
            raise cursor.error(
                f"where does the block of this {owner} end? Indent its lines, put braces around them, or write 'end'",
                owner.at,
            )
        return block
