"""A small controller for structured text: executes what blark has parsed, with the standard functions that we call."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator
from typing import Any

from blark import transform as st
from blark.parse import parse_source_code

Variables = dict[str, Any]
Expression = Callable[[Variables], Any]
Statement = Callable[[Variables], None]

OPERATORS = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "<=": operator.le, "<": operator.lt, ">": operator.gt,
    ">=": operator.ge,
}  # fmt: skip
FUNCTIONS = {"exp": math.exp, "abs": abs, "limit": lambda low, value, high: min(max(value, low), high)}
TYPES = {"lreal": float, "int": int, "dint": int, "lint": int}


class FunctionBlock:
    """One FUNCTION_BLOCK of a source: call it with its inputs in order, it returns its outputs by name."""

    def __init__(self, source: str) -> None:
        (self.block,) = parse_source_code(source).transform().items
        assert isinstance(self.block, st.FunctionBlock)
        self.inputs, self.outputs = [], []
        self.initial: Variables = {}
        for section in self.block.declarations:
            for item in section.items:
                self._declare(section, item)
        self.body = [_statement(statement) for statement in self.block.body.statements]

    def __call__(self, *inputs: float) -> dict[str, Any]:
        variables = dict(self.initial)
        variables.update(zip(self.inputs, inputs, strict=True))
        for statement in self.body:
            statement(variables)
        return {name: variables[name] for name in self.outputs}

    def _declare(self, section: Any, item: Any) -> None:
        kind = str(item.init.spec.type if hasattr(item.init.spec, "type") else item.init.spec).lower()
        for declared in item.variables:
            name = str(declared.variable.name).lower() if hasattr(declared, "variable") else str(declared.name).lower()
            assert name not in self.initial, f"{name} is declared twice"
            if isinstance(section, st.InputDeclarations):
                self.inputs.append(name)
            elif isinstance(section, st.OutputDeclarations):
                self.outputs.append(name)
            value = item.init.value
            if isinstance(value, st.ArrayInitialization):
                self.initial[name] = _array(item, list(_elements(value)))
            elif "array" in kind or isinstance(item.init.spec, st.ArraySpecification):
                self.initial[name] = [None] * _length(item)
            else:
                self.initial[name] = TYPES[kind](0)


def _array(item: Any, values: list[Any]) -> list[Any]:
    assert len(values) == _length(item), f"{len(values)} initial values for {item}"
    return values


def _length(item: Any) -> int:
    (subrange,) = item.init.spec.subranges
    assert int(str(subrange.start)) == 0
    return int(str(subrange.stop)) + 1


def _elements(initial: Any) -> Iterator[Any]:
    for element in initial.elements:
        if isinstance(element.element, st.ArrayInitialization):  # how blark holds the second element and on
            yield from _elements(element.element)
        else:
            yield _expression(element.element)({})


def _statement(node: Any) -> Statement:
    if isinstance(node, st.AssignmentStatement):
        (target,), value = node.variables, _expression(node.expression)
        return lambda variables: _assign(target, value(variables), variables)
    if isinstance(node, st.IfStatement):
        assert not node.else_ifs
        test, then = _expression(node.if_expression), _block(node.statements)
        otherwise = _block(node.else_clause.statements if node.else_clause else None)
        return lambda variables: then(variables) if test(variables) else otherwise(variables)
    if isinstance(node, st.WhileStatement):
        test, body = _expression(node.expression), _block(node.statements)

        def loop(variables: Variables) -> None:
            while test(variables):
                body(variables)

        return loop
    if isinstance(node, st.ForStatement):
        first, last, body = _expression(node.from_), _expression(node.to), _block(node.statements)

        def count(variables: Variables) -> None:
            for value in range(first(variables), last(variables) + 1):
                _assign(node.control, value, variables)
                body(variables)

        return count
    raise TypeError(f"{type(node).__name__}: {node}")


def _block(statements: Any) -> Statement:
    parts = [_statement(statement) for statement in statements.statements] if statements else []

    def run(variables: Variables) -> None:
        for part in parts:
            part(variables)

    return run


def _assign(target: Any, value: Any, variables: Variables) -> None:
    if isinstance(target, st.MultiElementVariable):
        ((index,),) = (element.subscripts for element in target.elements)
        variables[str(target.name.name).lower()][_expression(index)(variables)] = value
    else:
        name = str(target.name).lower()
        assert name in variables, f"{name} is not declared"
        variables[name] = value


def _expression(node: Any) -> Expression:
    if isinstance(node, st.Real | st.Integer):
        value = float(str(node.value)) if isinstance(node, st.Real) else int(str(node.value))
        return lambda variables: value
    if isinstance(node, st.SimpleVariable):
        name = str(node.name).lower()
        return lambda variables: variables[name]
    if isinstance(node, st.MultiElementVariable):
        name = str(node.name.name).lower()
        ((index,),) = (element.subscripts for element in node.elements)
        at = _expression(index)
        return lambda variables: variables[name][at(variables)]
    if isinstance(node, st.ParenthesizedExpression):
        return _expression(node.expr)
    if isinstance(node, st.UnaryOperation):
        inner = _expression(node.expr)
        assert node.op == "-"
        return lambda variables: -inner(variables)
    if isinstance(node, st.BinaryOperation):
        return _binary(str(node.op), _expression(node.left), _expression(node.right))
    if isinstance(node, st.FunctionCall):
        function = FUNCTIONS[str(node.name.name).lower()]
        arguments = [_expression(parameter.value) for parameter in node.parameters]
        return lambda variables: function(*(argument(variables) for argument in arguments))
    raise TypeError(f"{type(node).__name__}: {node}")


def _binary(sign: str, left: Expression, right: Expression) -> Expression:
    if sign == "/":
        return lambda variables: left(variables) / right(variables)
    operation = OPERATORS[sign]

    def compute(variables: Variables) -> Any:
        a, b = left(variables), right(variables)
        assert type(a) is type(b), f"{a!r} {sign} {b!r}: an integer meets a real number, which controllers refuse"
        return operation(a, b)

    return compute
