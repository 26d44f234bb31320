"""A chain of layers, put together step by step by the readers of files and modules, and the network that it is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Argmax, Identity, Sign, TanhBox
from otr.core.network import ReluNetwork
from otr.core.smooth_network import Oracle, SmoothNetwork
from otr.errors import InvalidNetworkError

TRAIN_RELU = (
    "a tree needs ReLU or LeakyReLU: train with torch.nn.ReLU (in Stable-Baselines3, "
    "policy_kwargs=dict(activation_fn=torch.nn.ReLU))"
)
# Only where `read_policy` reads the policy
RELU_REMEDY = f"{TRAIN_RELU}, or imitate the policy, as otr-run method=augtree does"
_LIMIT_ENTRIES = 2**24  # of a matrix: a product of thin ones can be far larger than the file
_LIMIT_WIDTH = 2**20  # of a value: a file of a hundred bytes can declare any number of inputs
DECIDED_BY: dict[str, Head] = {"Sigmoid": Sign(), "Softmax": Argmax(), "LogSoftmax": Argmax()}
_UNITS_OF_ENDS = {"Tanh": "tanh", "Sigmoid": "sigmoid"}  # what an end is where another layer follows


@contextmanager
def naming(step: str) -> Iterator[None]:
    """Put the name of a step before what an InvalidNetworkError says of it."""
    try:
        yield
    except InvalidNetworkError as error:
        raise InvalidNetworkError(f"{step} {error}") from error


def mappable(policy: Oracle) -> ReluNetwork:
    """Return a policy of ReLU units, or raise InvalidNetworkError, which says what to do."""
    if isinstance(policy, SmoothNetwork):
        raise InvalidNetworkError(f"the units are {policy.activation}; {RELU_REMEDY}")
    return policy


@dataclass(frozen=True)
class Chain:
    """A value that is computed from the states by one layer after another: an array of numbers for each state.

    Before the end it is ``scale * a + offset`` of the activations a (the states, at first) where `is_activated`, else
    the outputs of the last layer. After a Tanh it is ``half * tanh(y) + middle``; all of it lies in [low, high].

    Every step returns the longer chain, or raises InvalidNetworkError with what is wrong; `naming` says where.
    """

    shape: tuple[int, ...]  # of the value, for one state
    layers: tuple[tuple[FloatArray, FloatArray], ...] = ()
    units: frozenset[float | str] = frozenset()  # slopes below zero, and names of smooth activations
    is_activated: bool = True
    scale: FloatArray | float = 1.0
    offset: FloatArray | float = 0.0
    end: str = ""  # the last step, where it is the end of all, or tanh or sigmoid units
    half: FloatArray | float = 1.0
    middle: FloatArray | float = 0.0
    low: FloatArray | float = -math.inf
    high: FloatArray | float = math.inf
    is_batch: bool = True  # whether an axis of states stands before `shape`

    def __post_init__(self) -> None:
        if self.width > _LIMIT_WIDTH:
            raise InvalidNetworkError(
                f"there are {self.width:,} numbers for each state, the limit is {_LIMIT_WIDTH:,}; is it the right file?"
            )

    @property
    def width(self) -> int:
        """How many numbers the value has."""
        return math.prod(self.shape)

    @property
    def deciding_head(self) -> Head | None:
        """The head that decides as the probabilities do in which the chain ends; None where it ends in none."""
        return DECIDED_BY.get(self.end)

    def linear(self, W: FloatArray, b: ArrayLike | None = None) -> Chain:
        """W @ value + b, W (n_out, n_in), multiplied with the layer before where no activation lies between."""
        before = self._as_units() if self.end in _UNITS_OF_ENDS else self
        before._require_open()
        if W.ndim != 2 or W.shape[1] != self.width or W.size == 0:
            raise InvalidNetworkError(
                f"has weights of shape {W.T.shape}, expected ({self.width}, n_out): it reads {self.width} values"
            )
        if before.is_activated:
            layers = (*before.layers, (W * before.scale, W @ np.broadcast_to(before.offset, self.width)))
        else:
            *earlier, (W_before, b_before) = before.layers
            _require_moderate(len(W), W_before.shape[1])
            layers = (*earlier, (W @ W_before, W @ b_before))
        made = replace(before, shape=(len(W),), layers=layers, is_activated=False, scale=1.0, offset=0.0)
        return made if b is None else made.affine(1.0, b)

    def affine(self, scale: ArrayLike, offset: ArrayLike) -> Chain:
        """scale * value + offset, of numbers or rows (width,)."""
        scale, offset = self._row(scale), self._row(offset)
        made = self
        if self.end:
            if self.end not in ("Tanh", "Clip") or not np.all(scale > 0):
                raise InvalidNetworkError(f"comes after {self.end}; only shifts and positive scales may")
            made = replace(self, low=self.low * scale + offset, high=self.high * scale + offset)
            if self.end == "Tanh":
                return replace(made, half=self.half * scale, middle=self.middle * scale + offset)
        if made.is_activated:
            return replace(made, scale=made.scale * scale, offset=made.offset * scale + offset)
        *earlier, (W, b) = made.layers
        return replace(made, layers=(*earlier, (W * scale[:, None], b * scale + offset)))

    def arithmetic(self, operation: str, constant: ArrayLike, *, constant_first: bool = False) -> Chain:
        """The operation add, sub, mul or div of the value and a constant."""
        row = self._row(constant)
        if operation == "add":
            return self.affine(1.0, row)
        if operation == "sub":
            return self.affine(-1.0, row) if constant_first else self.affine(1.0, -row)
        if operation == "mul":
            return self.affine(row, 0.0)
        if constant_first or not row.all():
            raise InvalidNetworkError(f"divides by {'the states' if constant_first else 'zero'}")
        return self.affine(1.0 / row, 0.0)

    def activation(self, unit: float | str) -> Chain:
        """A leaky ReLU of this slope below zero, or a smooth activation by name; tanh and sigmoid may be the end."""
        end = {name: end for end, name in _UNITS_OF_ENDS.items()}.get(str(unit))
        self._require_open()
        if end:
            return replace(self, end=end)
        if self.is_activated:
            raise InvalidNetworkError("follows no layer with weights; put one before it")
        return replace(self, is_activated=True, units=self.units | {unit})

    def clip(self, low: ArrayLike | None, high: ArrayLike | None) -> Chain:
        """The value within limits, numbers or rows; None for no limit on a side."""
        if self.end not in ("", "Tanh", "Clip"):
            raise InvalidNetworkError(f"comes after {self.end}")
        self._require_vector()
        low = self._row(-math.inf if low is None else low)
        high = self._row(math.inf if high is None else high)
        # The later limit wins: a lower one above the upper one is that only if it comes after it.
        if not (np.all(low < high) and np.all(low < self.high) and np.all(high > self.low)):
            raise InvalidNetworkError("leaves one answer only in some output")
        low, high = np.maximum(self.low, low), np.minimum(self.high, high)
        return replace(self, end=self.end or "Clip", low=low, high=high)

    def decision(self, kind: str, axis: int | None = 0) -> Chain:
        """ArgMax, or Softmax and LogSoftmax, before which a head answers the same, over this axis of the value."""
        if self.end and not (kind == "ArgMax" and "Softmax" in self.end):
            raise InvalidNetworkError(f"comes after {self.end}")
        self._require_vector()
        if axis not in (0, -1):
            raise InvalidNetworkError(
                "goes over the states or several axes, expected each state's first largest output"
            )
        return replace(self, end=kind)

    def reshaped(self, shape: tuple[int, ...]) -> Chain:
        """The same numbers in another shape."""
        if math.prod(shape) != self.width:
            raise InvalidNetworkError(f"makes {self.width} numbers of each state to the shape {shape}")
        return replace(self, shape=shape)

    def network(self, head: Head | None = None) -> Oracle:
        """Return the network, with the head of its end, or with `head` where it ends without one.

        Raises:
            InvalidNetworkError: it has no layer with weights, units of several kinds, an end that no head is, or
                another head than `head`.
        """
        if not self.layers:
            raise InvalidNetworkError("no layer with weights lies between the states and the answer")
        found = self._head()
        if self.end in DECIDED_BY:
            if head != found:
                raise InvalidNetworkError(
                    f"the model ends in {self.end}; it needs head=otr.{type(found).__name__}(), "
                    "as the tree answers with the label and not the probability"
                )
        elif head is not None and self.end and head != found:
            raise InvalidNetworkError(f"head is {head!r}, the model ends in {self.end}: {found!r}; leave head out")
        if len(self.units) > 1:
            if all(isinstance(unit, float) for unit in self.units):
                told = f"activations have the slopes {sorted(self.units)} below zero; one network has one slope"
            else:
                told = f"the units are {', '.join(sorted(map(_unit_name, self.units)))}; one network has one kind"
            raise InvalidNetworkError(told)
        weights, biases = [W for W, _ in self.layers], [b for _, b in self.layers]
        if self.is_activated:  # the activations are the answer, up to a scale: one more layer that passes them on
            with naming("the last activation"):
                _require_moderate(self.width, self.width)
            weights.append(np.eye(self.width) * self.scale)
            biases.append(np.broadcast_to(np.asarray(self.offset, dtype=np.float64), self.width))
        unit, head = next(iter(self.units), 0.0), found if self.end else head
        if isinstance(unit, str):
            return SmoothNetwork(weights, biases, activation=unit, head=head)
        return ReluNetwork(weights, biases, negative_slope=unit, head=head)

    def _as_units(self) -> Chain:
        """Return the chain with its last step, tanh or sigmoid, as the units of a hidden layer."""
        if self.is_activated:
            raise InvalidNetworkError(f"comes after {self.end}, which follows no layer with weights")
        if np.any(np.isfinite(self.low)) or np.any(np.isfinite(self.high)):
            raise InvalidNetworkError("comes after Clip; nothing but a scale, a shift and a clip may")
        units = self.units | {_UNITS_OF_ENDS[self.end]}
        return replace(self, end="", is_activated=True, units=units, scale=self.half, offset=self.middle,
                       half=1.0, middle=0.0, low=-math.inf, high=math.inf)  # fmt: skip

    def _require_open(self) -> None:
        if self.end:
            raise InvalidNetworkError(f"comes after {self.end}; nothing but a scale, a shift and a clip may")
        self._require_vector()

    def _require_vector(self) -> None:
        if len(self.shape) != 1:
            raise InvalidNetworkError(f"reads the shape {self.shape} of each state; put a Flatten before it")

    def _row(self, value: ArrayLike) -> FloatArray:
        """Return a constant that is added to, or multiplies, every row: (width,)."""
        self._require_vector()
        row = np.asarray(value, dtype=np.float64)
        # A constant with more axes than the value adds axes to the result, so that an argmax goes over another axis.
        fits = row.ndim <= 1 + self.is_batch and math.prod(row.shape[:-1]) == 1
        if not fits or (row.ndim and row.shape[-1] not in (1, self.width)):
            raise InvalidNetworkError(f"has a constant of shape {row.shape}, expected ({self.width},)")
        return np.broadcast_to(row.ravel(), self.width)

    def _head(self) -> Head:
        if self.end == "ArgMax":
            return Argmax()
        if self.end in DECIDED_BY:
            return DECIDED_BY[self.end]
        low, high = (np.broadcast_to(limit, self.width) for limit in (self.low, self.high))
        if self.end == "Clip" and not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise InvalidNetworkError(
                f"the answers are clipped to {low.tolist()} .. {high.tolist()}; expected finite limits on both sides"
            )
        if self.end != "Tanh":
            return Identity().clipped_to(low, high) if self.end else Identity()
        half, middle = np.asarray(self.half), np.asarray(self.middle)
        try:
            return TanhBox(*np.broadcast_arrays(middle - half, middle + half)).clipped_to(low, high)
        except ValueError as error:
            raise InvalidNetworkError(str(error)) from error


def _unit_name(unit: float | str) -> str:
    return unit if isinstance(unit, str) else "relu" if unit == 0 else "leaky relu"


def _require_moderate(rows: int, columns: int) -> None:
    if rows * columns > _LIMIT_ENTRIES:
        raise InvalidNetworkError(
            f"makes a matrix of {rows} x {columns} numbers, the limit is {_LIMIT_ENTRIES:,}; a network of this width "
            "has no tree that can be held"
        )
