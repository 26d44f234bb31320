"""Calls within calls as deep as a program's blocks are nested, which is deeper than Python's own may be."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, TypeAlias, TypeVar

T = TypeVar("T")
# A function that yields the steps of each function that it calls, and is sent what that returned
Steps: TypeAlias = Generator[Any, Any, T]


def result_of(steps: Steps[T]) -> T:
    """Return what steps return, having done those that they yield, and those that these yield, one after the other."""
    under_way: list[Steps[Any]] = [steps]
    returned = None
    while under_way:
        try:
            under_way.append(under_way[-1].send(returned))
            returned = None
        except StopIteration as end:
            under_way.pop()
            returned = end.value
    return returned  # type: ignore[return-value]
