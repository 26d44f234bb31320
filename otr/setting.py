"""What a setting may be, declared at the field of its dataclass: enforced from there, by the library and the commands.

    momentum: Annotated[float, Range(0, 1, open=True)] = 0.0

A dataclass may also have a method `problem(prefix)`, which returns what is wrong between its settings, or None.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Annotated, Any, get_args, get_type_hints


@dataclass(frozen=True)
class Range:
    """A number from `low` to `high`, or below it where `open`; of a list or a dict, every number in it.

    `remedy` says what to give, where that adds to the bounds.
    """

    low: float = -math.inf
    high: float = math.inf
    open: bool = False
    remedy: str = ""

    def problem(self, value: Any) -> str | None:
        """Return what is wrong with a value, to be printed after it; None where nothing is."""
        if isinstance(value, bool) or not isinstance(value, Real):
            return " is not a number"
        if self.low <= float(value) < self.high or (value == self.high and not self.open):
            return None
        if self.open or self.remedy:
            return f": {self.remedy or f'give a number{self.limits}'}"
        low, high = _number(self.low), _number(self.high)
        return f" is not at least {low}" if self.high == math.inf else f" is not between {low} and {high}"

    @property
    def limits(self) -> str:
        """The bounds as text, to be printed after a setting's type."""
        if self.high == math.inf:
            return "" if self.low == -math.inf else f" of at least {_number(self.low)}"
        return f" from {_number(self.low)} to {'below ' * self.open}{_number(self.high)}"


class OneOf:
    """One of these texts."""

    def __init__(self, *options: str) -> None:
        self.options = options

    def problem(self, value: Any) -> str | None:
        """Return what is wrong with a value, to be printed after it; None where nothing is."""
        return None if value in self.options else f": use one of {', '.join(self.options)}"


@dataclass(frozen=True)
class AsBefore:
    """A setting younger than committed results: keyed only where it differs from `value`, which means "as before"."""

    value: Any


Count = Annotated[int, Range(1)]
CountOrZero = Annotated[int, Range(0)]
Share = Annotated[float, Range(0, 1)]
BelowOne = Annotated[float, Range(0, 1, open=True)]
Positive = Annotated[float, Range(1e-12)]
NotNegative = Annotated[float, Range(0)]
LearningRate = Annotated[float, Range(1e-12, 10)]
Hardness = Annotated[float, Range(1e-6, 1e6)]  # of a soft tree's tests
Criterion = Annotated[str, OneOf("gini", "entropy")]
Leaves = Annotated[str, OneOf("constant", "linear")]


@functools.cache
def declared(kind: type) -> dict[str, tuple[Any, ...]]:
    """Return the markers of every field of a dataclass, in order, those of its parts' types included."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: tuple(_markers(hints[field.name])) for field in dataclasses.fields(kind)}


def check_settings(settings: Any) -> None:
    """Raise ValueError if a setting of a dataclass is not in its field's range, or no whole number where that is."""
    kind: Any = type(settings)
    kinds = get_type_hints(kind)
    for name in declared(kind):
        value = getattr(settings, name)
        wrong = problem(kind, name, value, name)
        if wrong is None and kinds[name] is int and not isinstance(value, Integral):
            wrong = f"{name}={value} is not a whole number"
        if wrong is not None:
            raise ValueError(wrong)
    between: str | None = settings.problem("") if hasattr(settings, "problem") else None
    if between is not None:
        raise ValueError(between)


class Checked:
    """Base of dataclasses that cannot be made with a setting out of its range."""

    def __post_init__(self) -> None:
        """Raise ValueError as `check_settings`."""
        check_settings(self)


def problem(kind: Any, name: str, value: Any, key: str) -> str | None:
    """Return why the field `name` of `kind` cannot have this value, called `key`; None where it can."""
    if isinstance(value, dict):
        return next(filter(None, (problem(kind, name, value[part], f"{key}.{part}") for part in value)), None)
    for marker in declared(kind)[name]:
        for leaf in _leaves(value) if hasattr(marker, "problem") else ():
            wrong = marker.problem(leaf)
            if wrong:
                part = "" if leaf is value or wrong[0] == ":" else f": {leaf}"
                return f"{key}={value}{part}{wrong}" if value != "" else f"{key}{wrong}"
    return None


def _markers(hint: Any) -> Iterator[Any]:
    """Yield the markers in a type, at any depth: of `list[Count] | None`, those of Count."""
    yield from getattr(hint, "__metadata__", ())
    for part in (hint.__origin__,) if hasattr(hint, "__metadata__") else get_args(hint):
        yield from _markers(part)


def _leaves(value: Any) -> Iterator[Any]:
    """Yield what is in a list, at any depth; of anything else itself, and of None nothing."""
    if isinstance(value, list | tuple):
        for part in value:
            yield from _leaves(part)
    elif value is not None:
        yield value


def _number(value: float) -> str:
    return str(int(value)) if math.isfinite(value) and value == int(value) else f"{value:g}"
