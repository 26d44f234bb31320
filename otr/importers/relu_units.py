"""Nodes of a graph, and units and heads, recognised by their values: an operator's name does not matter."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_softmax, softmax

from otr.core.arrays import FloatArray

Function = Callable[[FloatArray], NDArray[Any]]
DECISIONS: dict[str, Function] = {"Softmax": softmax, "LogSoftmax": log_softmax}
_OF_HEADS: dict[str, Function] = {"tanh": np.tanh, "sigmoid": expit, **DECISIONS}
_FAR = 2.0**900
_NO_LIMIT = 3.4e38  # of float32: what clips there clips nothing
_SCALES = (0.1, 1.0, 3.0, 10.0, 1000.0)


@dataclass(frozen=True)
class Unit:
    """A function of a vector: piecewise linear number by number, or one with which a policy ends.

    Attributes:
        kind: "slope": z above zero and slope * z below; "clip" to [low, high]; tanh, sigmoid, Softmax, LogSoftmax or
            ArgMax.
        slope, low, high: (n,), for these two kinds; ReLU has all of them.
    """

    kind: str
    slope: FloatArray | None = None
    low: FloatArray | None = None
    high: FloatArray | None = None


@dataclass(frozen=True)
class Node:
    """One operation.

    Attributes:
        name: in messages, with the operator.
        inputs, outputs: names of values; an input "" is left out.
        run: from the inputs' arrays (None for one left out) to the outputs'; it changes none of them.
        reads_shape: whether the answer depends on the shape of what it reads and not on its numbers.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    run: Callable[[list[Any]], Sequence[Any]]
    reads_shape: bool = False


@dataclass(frozen=True)
class Source:
    """What a section reads: the states, or the answer of a cut."""

    name: str
    shape: tuple[int, ...]
    node: Node | None = None
    read: str = ""  # the value that the cut reads
    unit: Unit | None = None  # None for one that was not recognised
    is_real: bool = True

    @property
    def width(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)


@dataclass(frozen=True)
class Form:
    """A value as a sum over sources: sum of matrices[name] @ source + offset, all flattened."""

    matrices: dict[str, FloatArray]
    offset: FloatArray


@dataclass(frozen=True)
class Neurons:
    """Piecewise linear units as ReLU neurons: offset + the sum of gains * relu(signs * z[rows] + shifts).

    Arrays are (n_neurons,), `offset` is (n,).
    """

    rows: NDArray[np.int64]
    signs: FloatArray
    shifts: FloatArray
    gains: FloatArray
    offset: FloatArray


def recognised(answer: Function, width: int, rng: np.random.Generator) -> Unit | None:
    """Return the unit that `answer` is, a function of vectors (width,); None for one that is not known."""
    with np.errstate(all="ignore"):
        found = answer(np.zeros(width))
        n_each = 1 + 32 // width
        tried = [scale * rng.standard_normal(width) for scale in _SCALES for _ in range(n_each)]
        # Numbers of all sizes, as a comparison may choose another function anywhere
        tried += [rng.standard_normal(width) * 2.0 ** rng.integers(-30, 100, width) for _ in range(n_each)]
        if found.dtype.kind == "i" and found.size == 1:
            ties = [np.zeros(width), np.abs(tried[0]).round(1)]
            is_argmax = all(int(answer(z)[0]) == int(np.argmax(z)) for z in (*tried, *ties))
            return Unit("ArgMax") if is_argmax else None
        if found.dtype.kind != "f" or found.size != width:
            return None
        slope = 0.0 - answer(np.full(width, -1.0))
        candidates: list[tuple[Unit, Function]] = [
            (Unit("slope", slope=slope), lambda z: np.where(z > 0, z, slope * z))
        ]
        low, high = (answer(np.full(width, far)) for far in (-_FAR, _FAR))
        low, high = np.where(low > -_NO_LIMIT, low, -np.inf), np.where(high < _NO_LIMIT, high, np.inf)
        if not (np.isnan(low).any() or np.isnan(high).any()) and np.all(low < high):
            candidates.append((Unit("clip", low=low, high=high), lambda z: np.clip(z, low, high)))
            for limit in (low, high):  # so that points are on both sides of it
                near = np.where(np.isfinite(limit), limit, 0.0)
                tried += [near + 1e-3 * (1 + np.abs(near)) * rng.standard_normal(width) for _ in range(3)]
        candidates += [(Unit(name), function) for name, function in _OF_HEADS.items()]
        expected = [answer(z) for z in tried]
        for unit, function in candidates:
            far = 100 if unit.kind in DECISIONS else np.inf  # where onnx's reference has infinite logarithms
            given = [(z, y) for z, y in zip(tried, expected, strict=True) if np.abs(z).max() < far]
            if all(np.allclose(function(z), y, rtol=1e-9, atol=1e-13) for z, y in given):
                is_relu = unit.slope is not None and not unit.slope.any()
                return Unit("slope", slope, np.zeros(width), np.full(width, np.inf)) if is_relu else unit
    return None


def neurons(unit: Unit, width: int) -> Neurons:
    """Return piecewise linear units as ReLU neurons."""
    if unit.slope is not None:
        parts = [(np.ones(width, dtype=np.bool_), 1.0, np.zeros(width), np.ones(width))]
        parts.append((unit.slope != 0, -1.0, np.zeros(width), -unit.slope))
        offset = np.zeros(width)
    else:
        assert unit.low is not None and unit.high is not None
        has_low, has_high = np.isfinite(unit.low), np.isfinite(unit.high)
        ones = np.ones(width)
        parts = [
            (has_low, 1.0, -unit.low, ones),
            (has_low & has_high, 1.0, -unit.high, -ones),
            (~has_low & has_high, -1.0, unit.high, -ones),
            (~has_low & ~has_high, 1.0, 0 * ones, ones),  # z = relu(z) - relu(-z)
            (~has_low & ~has_high, -1.0, 0 * ones, -ones),
        ]
        offset = np.where(has_low, unit.low, np.where(has_high, unit.high, 0.0))
    rows = [np.flatnonzero(which) for which, *_ in parts]
    return Neurons(
        np.concatenate(rows),
        np.concatenate([np.full(len(r), sign) for r, (_, sign, _, _) in zip(rows, parts, strict=True)]),
        np.concatenate([shift[r] for r, (_, _, shift, _) in zip(rows, parts, strict=True)]),
        np.concatenate([gain[r] for r, (_, _, _, gain) in zip(rows, parts, strict=True)]),
        offset,
    )
