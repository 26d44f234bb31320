"""The nodes of a torch export, each of which torch runs in float64, by its operators alone."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.errors import InvalidNetworkError
from otr.importers.sections import LIMIT_NUMBERS, Node, Sections
from otr.importers.torch_export_file import Call, Export, Name, Type, names_in, read_export

_OF_SIZES: dict[str, Callable[..., Any]] = {
    f"_operator.{name}": getattr(operator, name) for name in ("add", "sub", "mul", "floordiv", "mod", "neg", "getitem")
}
_TEXTS = ("none", "tanh", "floor", "trunc")  # arguments of gelu and div; a text could name a file elsewhere
# Codes of torch's types in the JSON; float32 is computed in float64 here.
_TYPES = {1: "uint8", 2: "int8", 3: "int16", 4: "int32", 5: "int64", 6: "float16", 7: "float64", 8: "float64",
          12: "bool", 13: "bfloat16"}  # fmt: skip


def sections_of_export(file: Path | bytes) -> tuple[Sections, Callable[[FloatArray], NDArray[np.float64]]]:
    """Return the sections of an archive of `torch.export.save`, and what the whole answers on one state.

    `otr.from_torch` documents what is read, and errors.
    """
    export = read_export(file)
    calls = [call for call in export.calls if not re.match(r"torch\.ops\.aten\.(_assert|sym_constrain)", call.target)]
    functions = [_function(call) for call in calls]
    nodes = [_node(call, function) for call, function in zip(calls, functions, strict=True)]
    constants: dict[str, Any] = {str(name): tensor for name, tensor in export.tensors.items()}
    sections = Sections(export.input_name, export.input_shape, nodes, constants, export.output_name)
    return sections, _whole(export, sections.input.shape, list(zip(calls, functions, strict=True)))


def _function(call: Call) -> Callable[..., Any]:
    """Return one of torch's pure operators on tensors, or Python's arithmetic of sizes."""
    import torch
    from torch._decomp import decomposition_table

    if call.target in _OF_SIZES:
        return _OF_SIZES[call.target]
    match = re.fullmatch(r"torch\.ops\.aten\.(\w+)\.(\w+)", call.target)
    found = getattr(getattr(torch.ops.aten, match[1], None), match[2], None) if match else None
    pure = getattr(getattr(torch.ops.aten, match[1].rstrip("_"), None), match[2], None) if match else None
    if isinstance(found, torch._ops.OpOverload):
        for each in (found, pure):
            is_known = isinstance(each, torch._ops.OpOverload) and (
                torch.Tag.core in each.tags
                or each in decomposition_table
                or each.has_kernel_for_dispatch_key(torch.DispatchKey.CompositeImplicitAutograd)
                or each.has_kernel_for_dispatch_key(torch.DispatchKey.CompositeExplicitAutograd)
            )
            if is_known:
                return found
    raise InvalidNetworkError(f"{call} is {call.target}, which is none of torch's operators on tensors")


def _node(call: Call, function: Callable[..., Any]) -> Node:
    import torch

    names = tuple(dict.fromkeys(names_in(call.arguments)))
    is_checked = False

    def run(operands: list[Any]) -> Sequence[Any]:
        nonlocal is_checked
        values: dict[str, Any] = {name: _tensor(value) for name, value in zip(names, operands, strict=True)}
        if not is_checked and function not in _OF_SIZES.values():
            _require_moderate(call, function, values)
            is_checked = True
        return [_array(each) for each in _results(_called(call, function, values, torch.device("cpu")))]

    return Node(str(call), names, call.outputs, run, reads_shape=call.target.startswith("torch.ops.aten.sym_"))


def _called(call: Call, function: Callable[..., Any], values: dict[str, Any], device: Any) -> Any:
    """Return what an operator makes of arguments, of which the named ones are `values`."""
    import torch

    def given(value: Any) -> Any:
        if isinstance(value, list):
            return [given(each) for each in value]
        if isinstance(value, Name):
            return values[value]
        if isinstance(value, Type):
            return getattr(torch, _TYPES[value])
        if isinstance(value, str) and value not in _TEXTS:
            raise InvalidNetworkError(f"has the text {value!r} as an argument, which cannot be read")
        return value

    arguments = {name: given(value) for name, value in call.arguments.items()}
    if function in _OF_SIZES.values():
        return function(*arguments.values())
    if "device" in arguments:
        arguments["device"] = device
    with torch.no_grad():
        return function(**arguments)


def _require_moderate(call: Call, function: Callable[..., Any], values: dict[str, Any]) -> None:
    """Raise InvalidNetworkError where the answer is too large, before it is computed."""
    import torch

    hollow = {
        name: torch.empty(value.shape, dtype=value.dtype, device="meta") if torch.is_tensor(value) else value
        for name, value in values.items()
    }
    for each in _results(_called(call, function, hollow, torch.device("meta"))):
        if torch.is_tensor(each) and each.numel() > LIMIT_NUMBERS:
            raise InvalidNetworkError(
                f"{call} makes {each.numel():,} numbers of a state, the limit is {LIMIT_NUMBERS:,}"
            )


def _whole(
    export: Export, shape: tuple[int, ...], calls: list[tuple[Call, Callable[..., Any]]]
) -> Callable[[FloatArray], NDArray[np.float64]]:
    """Return the program on one state, where operators in place change what others read, too."""
    import torch

    def answer(state: FloatArray) -> NDArray[np.float64]:
        values: dict[str, Any] = {name: _tensor(value) for name, value in export.tensors.items()}
        values[export.input_name] = _tensor(state.reshape(shape))
        for call, function in calls:
            made = _results(_called(call, function, values, torch.device("cpu")))
            values.update(zip(map(Name, call.outputs), made, strict=False))
        return np.asarray(_array(values[export.output_name])).ravel()

    return answer


def _results(made: Any) -> Sequence[Any]:
    return made if isinstance(made, list | tuple) else [made]


def _tensor(value: Any) -> Any:
    """Return an array's numbers as a tensor, which an operator may change, and a size as it is."""
    import torch

    return torch.tensor(value) if isinstance(value, np.ndarray) else value


def _array(value: Any) -> Any:
    import torch

    if not torch.is_tensor(value):
        return value
    kept = value.dtype in (torch.float16, torch.float32, torch.float64) or not value.is_floating_point()
    return (value if kept else value.double()).detach().numpy()
