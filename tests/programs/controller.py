"""A small controller for structured text: executes what blark has parsed, with the standard functions that we call."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator
from typing import Any

from blark import transform as st
from blark.parse import parse_source_code

Variables = dict[str, Any]

OPERATORS = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "<=": operator.le, "<": operator.lt, ">": operator.gt,
    ">=": operator.ge, "/": operator.truediv,
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

    def __call__(self, *inputs: float) -> dict[str, Any]:
        variables = dict(self.initial)
        variables.update(zip(self.inputs, inputs, strict=True))
        _run(self.block.body, variables)
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
                self.initial[name] = list(_elements(value))
                assert len(self.initial[name]) == _length(item), f"the initial values of {item}"
            elif "array" in kind or isinstance(item.init.spec, st.ArraySpecification):
                self.initial[name] = [None] * _length(item)
            else:
                self.initial[name] = TYPES[kind](0)


def _length(item: Any) -> int:
    (subrange,) = item.init.spec.subranges
    assert int(str(subrange.start)) == 0
    return int(str(subrange.stop)) + 1


def _elements(initial: Any) -> Iterator[Any]:
    for element in initial.elements:
        if isinstance(element.element, st.ArrayInitialization):  # how blark holds the second element and on
            yield from _elements(element.element)
        else:
            yield _value(element.element, {})


def _run(statements: Any, variables: Variables) -> None:
    for node in statements.statements if statements else []:
        match node:
            case st.AssignmentStatement(variables=[target]):
                _assign(target, _value(node.expression, variables), variables)
            case st.IfStatement(else_ifs=[]) if _value(node.if_expression, variables):
                _run(node.statements, variables)
            case st.IfStatement(else_ifs=[]):
                _run(node.else_clause and node.else_clause.statements, variables)
            case st.WhileStatement():
                while _value(node.expression, variables):
                    _run(node.statements, variables)
            case st.ForStatement():
                for value in range(_value(node.from_, variables), _value(node.to, variables) + 1):
                    _assign(node.control, value, variables)
                    _run(node.statements, variables)
            case _:
                raise TypeError(f"{type(node).__name__}: {node}")


def _assign(target: Any, value: Any, variables: Variables) -> None:
    if isinstance(target, st.MultiElementVariable):
        variables[str(target.name.name).lower()][_index(target, variables)] = value
    else:
        name = str(target.name).lower()
        assert name in variables, f"{name} is not declared"
        variables[name] = value


def _index(node: Any, variables: Variables) -> int:
    ((index,),) = (element.subscripts for element in node.elements)
    return _value(index, variables)


def _value(node: Any, variables: Variables) -> Any:
    match node:
        case st.Real():
            return float(str(node.value))
        case st.Integer():
            return int(str(node.value))
        case st.SimpleVariable():
            return variables[str(node.name).lower()]
        case st.MultiElementVariable():
            return variables[str(node.name.name).lower()][_index(node, variables)]
        case st.ParenthesizedExpression():
            return _value(node.expr, variables)
        case st.UnaryOperation(op="-"):
            return -_value(node.expr, variables)
        case st.BinaryOperation():
            a, b = _value(node.left, variables), _value(node.right, variables)
            sign = str(node.op)
            refused = f"{a!r} {sign} {b!r}: an integer meets a real number, which controllers refuse"
            assert type(a) is type(b), refused
            return OPERATORS[sign](a, b)
        case st.FunctionCall():
            arguments = [_value(parameter.value, variables) for parameter in node.parameters]
            return FUNCTIONS[str(node.name.name).lower()](*arguments)
    raise TypeError(f"{type(node).__name__}: {node}")
