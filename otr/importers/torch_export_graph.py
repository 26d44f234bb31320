"""A network from a torch export, operation by operation: each is a step of a chain of layers."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from otr.core.arrays import FloatArray
from otr.errors import InvalidNetworkError
from otr.importers.chain import Chain, naming
from otr.importers.torch_export_file import Export, Name, Node, read_export

_ACCEPTED = (
    "accepted are linear layers, relu and leaky_relu, add, sub, mul and div with constants, at the end tanh, clamp, "
    "hardtanh or argmax, and flatten, view and reshape of a state to a vector"
)
_FLOAT_TYPES, _INTEGER_TYPES = (7, 8), (4, 5)  # torch's codes for float32 and float64, int32 and int64
_KEEPS = ("alias", "clone", "contiguous", "detach", "lift_fresh_copy")  # operators that change no number


def chain_of_export(file: Path | bytes) -> Chain:
    """Return the layers of an archive of `torch.export.save`; `otr.from_torch` documents what is read, and errors."""
    export = read_export(file)
    shape = export.input_shape
    if not shape or not all(shape[1:]):
        shown = ", ".join(str(size or "?") for size in shape)
        raise InvalidNetworkError(
            f"the input {export.input_name!r} has the shape ({shown}), expected (n, number of inputs), of which n "
            "alone may be left open, or (number of inputs,); export the module again with states of this shape"
        )
    answer = _Reader(export).values.get(export.output_name)
    if not isinstance(answer, Chain):
        raise InvalidNetworkError(f"{export.output_name!r} is not computed from {export.input_name!r}")
    return answer


class _Reader:
    """The values of a graph's nodes, one after the other: chains, constants, and the number of states."""

    def __init__(self, export: Export) -> None:
        shape = export.input_shape
        self.is_batch = len(shape) > 1
        self.n_states = shape[0] if self.is_batch else 1
        states = Chain(shape[self.is_batch :], is_batch=self.is_batch)
        self.values: dict[Name, Any] = {**export.tensors, export.input_name: states}
        for node in export.nodes:
            with naming(str(node)):
                try:
                    self.values[node.output] = self._result(node)
                except (KeyError, TypeError, IndexError, AttributeError) as error:
                    told = f"has other arguments than are known here ({type(error).__name__}: {error})"
                    raise InvalidNetworkError(told) from error

    def _result(self, node: Node) -> Any:
        if node.operator == "_assert_tensor_metadata":
            return None
        given = {name: self._value(value) for name, value in node.arguments.items()}
        chains = [name for name, value in given.items() if isinstance(value, Chain)]
        if not chains:
            return _constant(node, given)
        if len(chains) > 1:
            raise InvalidNetworkError("joins two values that depend on the states; only a chain of layers can be read")
        (own,) = chains
        chain = given.pop(own)
        if node.operator == "sym_size":
            return Name("n") if self.is_batch and given["dim"] == 0 else chain.shape[given["dim"] - self.is_batch]
        if node.operator in _KEEPS:
            return chain
        if node.operator in ("flatten", "view", "reshape", "_unsafe_view"):
            return chain.reshaped(self._shape(node, chain, given))
        handler = _HANDLERS.get(node.operator)
        if handler is None:
            raise InvalidNetworkError(f"cannot be read; {_ACCEPTED}")
        axes = (1, -1) if self.is_batch else (0, -1)
        if "dim" in given and given["dim"] is not None:
            given["dim"] = 0 if given["dim"] in axes else 1
        return handler(chain, own, given)

    def _value(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self._value(each) for each in value]
        if not isinstance(value, Name):
            return value
        if value not in self.values:
            raise InvalidNetworkError(f"reads {value!r}, which is no value; {_ACCEPTED}")
        return self.values[value]

    def _shape(self, node: Node, chain: Chain, given: dict[str, Any]) -> tuple[int, ...]:
        """Return the shape of each state after an operator that may change nothing else."""
        if node.operator == "flatten":
            start, end = given.get("start_dim", 0), given.get("end_dim", -1)
            is_whole = start == self.is_batch and end in (-1, len(chain.shape) + self.is_batch - 1)
            shape = [chain.width]
        else:
            sizes = list(given.get("size", given.get("shape", [])))
            shape = sizes[self.is_batch :]
            first = sizes[0] if self.is_batch and sizes else None
            is_whole = first in (None, -1, Name("n"), self.n_states or None)
            if -1 in shape:
                known = -math.prod(shape)
                shape = [chain.width // max(known, 1) if size == -1 else size for size in shape]
        if not is_whole or not shape or any(not isinstance(size, int) or size < 1 for size in shape):
            raise InvalidNetworkError(f"changes more than the shape of each state; {_ACCEPTED}")
        return tuple(shape)


def _constant(node: Node, given: dict[str, Any]) -> Any:
    """Return what a node makes of constants alone."""
    value = given.get("self", given.get("input"))
    if isinstance(value, np.ndarray):
        if node.operator in _KEEPS:
            return value
        if value.ndim == 2 and (
            node.operator in ("t", "numpy_T")
            or (node.operator == "permute" and given["dims"] == [1, 0])
            or (node.operator == "transpose" and {given["dim0"] % 2, given["dim1"] % 2} == {0, 1})
        ):
            return value.T
    raise InvalidNetworkError("of constants cannot be read; export the module with constants worked out")


def _numbers(value: Any) -> FloatArray:
    """Return a constant, or raise InvalidNetworkError."""
    if isinstance(value, bool) or not isinstance(value, np.ndarray | float | int):
        raise InvalidNetworkError("reads something else than constant real numbers beside the states")
    return np.asarray(value, dtype=np.float64)


def _linear(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
    _require_rows(own == "input")
    bias = given.get("bias")
    return chain.linear(_numbers(given["weight"]), None if bias is None else _numbers(bias))


def _addmm(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
    """beta * self + alpha * mat1 @ mat2."""
    _require_rows(own == "mat1")
    made = chain.linear(given.get("alpha", 1) * _numbers(given["mat2"]).T)
    return made.affine(1.0, given.get("beta", 1) * _numbers(given["self"]))


def _matmul(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
    _require_rows(own == "self")
    return chain.linear(_numbers(given.get("mat2", given.get("other"))).T)


def _require_rows(is_first: bool) -> None:
    if not is_first:
        raise InvalidNetworkError("multiplies from the left; expected states in rows")


def _arithmetic(operation: str) -> Callable[[Chain, str, dict[str, Any]], Chain]:
    def step(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
        other, is_first = ("other" if own == "self" else "self"), own == "self"
        if given.get("rounding_mode") is not None or (given.get("alpha", 1) != 1 and not is_first):
            raise InvalidNetworkError(f"rounds, or multiplies the states on the way; {_ACCEPTED}")
        constant = given.get("alpha", 1) * _numbers(given[other])
        return chain.arithmetic(operation, constant, constant_first=not is_first)

    return step


def _rsub(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
    """other - alpha * self."""
    _require_rows(own == "self")
    return chain.affine(-given.get("alpha", 1), _numbers(given["other"]))


def _smooth(unit: str, **defaults: float | str) -> Callable[[Chain, str, dict[str, Any]], Chain]:
    """Return the step of a smooth unit, which is read with these arguments alone."""

    def step(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
        for name, default in defaults.items():
            if given.get(name, default) != default:
                raise InvalidNetworkError(f"has {name}={given[name]!r}, which cannot be read; use torch's {default!r}")
        return chain.activation(unit)

    return step


def _clip(low: str, high: str, *defaults: float | None) -> Callable[[Chain, str, dict[str, Any]], Chain]:
    """Return the step that clips to arguments of these names."""

    def step(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
        _require_rows(own == "self")
        limits = [given.get(name, default) for name, default in zip((low, high), defaults or (None, None), strict=True)]
        return chain.clip(*(None if limit is None else _numbers(limit) for limit in limits))

    return step


def _extremum(is_lower_limit: bool) -> Callable[[Chain, str, dict[str, Any]], Chain]:
    def step(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
        limit = _numbers(given["other" if own == "self" else "self"])
        return chain.clip(limit, None) if is_lower_limit else chain.clip(None, limit)

    return step


def _decision(kind: str) -> Callable[[Chain, str, dict[str, Any]], Chain]:
    return lambda chain, own, given: chain.decision(kind, given.get("dim"))


def _activation(unit: float | str) -> Callable[[Chain, str, dict[str, Any]], Chain]:
    return lambda chain, own, given: chain.activation(unit)


def _dropout(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
    if given["train"]:
        raise InvalidNetworkError("drops units as in training; call module.eval() before the export")
    return chain


def _to(chain: Chain, own: str, given: dict[str, Any]) -> Chain:
    kind = given.get("dtype")
    if kind is not None and kind not in (_INTEGER_TYPES if chain.end == "ArgMax" else _FLOAT_TYPES):
        raise InvalidNetworkError("rounds the numbers to another type than float32 and float64")
    return chain


_HANDLERS: dict[str, Callable[[Chain, str, dict[str, Any]], Chain]] = {
    "linear": _linear,
    "addmm": _addmm,
    "mm": _matmul,
    "matmul": _matmul,
    **{name: _arithmetic(name) for name in ("add", "sub", "mul", "div")},
    "rsub": _rsub,
    "neg": lambda chain, own, given: chain.affine(-1.0, 0.0),
    "relu": _activation(0.0),
    "leaky_relu": lambda chain, own, given: chain.activation(float(given.get("negative_slope", 0.01))),
    **{name: _activation(name) for name in ("tanh", "sigmoid", "silu", "selu", "mish", "hardsigmoid", "hardswish")},
    "log_sigmoid": _activation("logsigmoid"),
    "elu": _smooth("elu", alpha=1, scale=1, input_scale=1),
    "celu": _smooth("celu", alpha=1),
    "gelu": _smooth("gelu", approximate="none"),
    "softplus": _smooth("softplus", beta=1, threshold=20),
    **dict.fromkeys(("clamp", "clip"), _clip("min", "max")),
    "clamp_min": _clip("min", ""),
    "clamp_max": _clip("", "max"),
    "hardtanh": _clip("min_val", "max_val", -1.0, 1.0),
    "maximum": _extremum(True),
    "minimum": _extremum(False),
    "argmax": _decision("ArgMax"),
    **dict.fromkeys(("softmax", "_softmax"), _decision("Softmax")),
    **dict.fromkeys(("log_softmax", "_log_softmax"), _decision("LogSoftmax")),
    "dropout": _dropout,
    **dict.fromkeys(("to", "_to_copy"), _to),
}
