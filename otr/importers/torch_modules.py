"""Torch modules and exports: the graph that `torch.export` writes, whose operators torch runs one by one in float64.

A Sequential of torch's layers is run layer by layer. What is read is compared with the module.
"""

from __future__ import annotations

import copy
import inspect
import io
import logging
import operator
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.network import ReluNetwork
from otr.core.smooth_network import Oracle
from otr.errors import InvalidNetworkError
from otr.importers.assembly import Function, black_box, policy_of
from otr.importers.relu_units import Node
from otr.importers.sections import LIMIT_NUMBERS, MEMORY, NOT_FINITE, Sections
from otr.importers.torch_export_file import Call, Export, Name, Type, names_in, read_export

if TYPE_CHECKING:
    import torch

_CALLS = ("__call__", "_call_impl", "_wrapped_call_impl")  # by which torch runs a module's forward
_OF_SIZES: dict[str, Callable[..., Any]] = {
    f"_operator.{name}": getattr(operator, name) for name in ("add", "sub", "mul", "floordiv", "mod", "neg", "getitem")
}
_TEXTS = ("none", "tanh", "floor", "trunc")  # arguments of gelu and div; a text could name a file elsewhere
# Codes of torch's types in the JSON; float32 is computed in float64 here.
_TYPES = {1: "uint8", 2: "int8", 3: "int16", 4: "int32", 5: "int64", 6: "float16", 7: "float64", 8: "float64",
          12: "bool", 13: "bfloat16"}  # fmt: skip


def policy_of_module(module: torch.nn.Module, head: Head | None, *, decides: bool = False) -> ReluNetwork:
    """Return the network of a module; `otr.from_torch` documents arguments and errors."""
    import torch

    for name, tensor in chain(module.named_parameters(), module.named_buffers()):
        _require_numbers(tensor, f"tensor {name!r}")
        is_parameter = isinstance(tensor, torch.nn.Parameter)  # a buffer may hold infinite limits
        if torch.isnan(tensor).any() or (is_parameter and torch.isinf(tensor).any()):
            raise InvalidNetworkError(f"tensor {name!r}: {NOT_FINITE}")
    refuse_changes(module, "module")
    linear = _first_linear(module)
    copied = _copy(module)
    layers = list(_flat_layers(copied, "module"))
    if not all(type(layer).__module__.startswith("torch.nn.") for _, layer in layers):
        sections, answer = sections_of_export(
            exported(copied, torch.zeros(1, linear.in_features, dtype=linear.weight.dtype))
        )
        return policy_of(sections, head, decides=decides, answer=answer)
    copied.double()
    steps = [(f"{where} ({type(layer).__name__})", partial(_run, layer)) for where, layer in layers]
    matrices = {k: layer.weight.detach().numpy() for k, (_, layer) in enumerate(layers) if type(layer) is type(linear)}
    sections = Sections.of_steps(steps, linear.in_features, matrices)
    return policy_of(sections, head, decides=decides, answer=lambda state: _run(copied, state[None]).ravel())


def _first_linear(module: torch.nn.Module) -> Any:
    import torch

    linear = next((part for part in module.modules() if isinstance(part, torch.nn.Linear)), None)
    if linear is None:
        raise InvalidNetworkError(
            "there is no Linear layer, which would say how many inputs a state has; give the export of the module, "
            "torch.export.export(module, (states,))"
        )
    return linear


def oracle_of_module(module: torch.nn.Module) -> Oracle:
    """Return the policy of a module: its ReLU network, or else what torch answers."""
    import torch

    try:
        return policy_of_module(module, None, decides=True)
    except InvalidNetworkError:
        linear = _first_linear(module)
        refuse_changes(module, "module")
        return oracle_of_export(exported(_copy(module), torch.zeros(1, linear.in_features, dtype=linear.weight.dtype)))


def exported(module: Any, state: Any) -> bytes:
    """Return the bytes of a module's export."""
    import torch

    if any(isinstance(part, torch.nn.RNNBase) for part in module.modules()):
        raise InvalidNetworkError(MEMORY.format("the module"))
    silenced = logging.root.manager.disable
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            logging.disable(logging.ERROR)  # torch prints its stack
            written = io.BytesIO()
            torch.export.save(torch.export.export(module, (state,)), written)
    except Exception as error:  # foreign code can fail in any way
        parts = ", ".join(f"module.{name}" for name, _ in module.named_children()) or "none"
        raise InvalidNetworkError(
            f"the module cannot be exported for a state of {state.numel()} inputs ({str(error).strip()[:300]}); give a "
            f"module whose forward(states) returns the actions alone, such as one of its parts ({parts}), or its "
            "export, torch.export.export(module, (states,))"
        ) from error
    finally:
        logging.disable(silenced)
    return written.getvalue()


def _run(module: Any, states: FloatArray) -> NDArray[Any]:
    import torch

    with torch.no_grad():
        return np.asarray(module(torch.tensor(states)).detach().cpu().numpy())


def _flat_layers(module: Any, name: str) -> Iterable[tuple[str, Any]]:
    """Yield (position, layer) of nested Sequentials in order."""
    import torch

    if isinstance(module, torch.nn.Sequential) and type(module).forward is torch.nn.Sequential.forward:
        for position, child in enumerate(module):  # named_children() leaves out the second use of a layer
            yield from _flat_layers(child, f"{name}[{position}]")
    else:
        yield name, module


def refuse_changes(module: Any, name: str) -> None:
    """Raise InvalidNetworkError where a hook, or a function in place of torch's, may change what layers answer.

    Whatever a module answers on some states, these can act on others. Parametrisations are modules, too.
    """
    import torch

    on_all = torch.nn.modules.module
    if on_all._global_forward_hooks or on_all._global_forward_pre_hooks:
        raise InvalidNetworkError(
            "a forward hook on all modules is registered, which may change what layers answer: call remove() of what "
            "torch.nn.modules.module.register_module_forward_hook, or _forward_pre_hook, returned"
        )
    for path, part in module.named_modules():
        where = "".join((name, *(f"[{step}]" if step.isdigit() else f".{step}" for step in path.split(".") if step)))
        for hook in (*part._forward_pre_hooks.values(), *part._forward_hooks.values()):
            raise InvalidNetworkError(
                f"{where} has a forward hook ({type(hook).__name__}), which may change what it answers: remove it, by "
                "remove() of its handle, or torch.nn.utils.remove_weight_norm or remove_spectral_norm of one of these"
            )
        replaced = [each for each in vars(part) if inspect.isfunction(getattr(type(part), each, None))]
        if any(getattr(type(part), each) is not getattr(torch.nn.Module, each) for each in _CALLS):
            replaced.append("__call__")
        if replaced:
            raise InvalidNetworkError(
                f"{where} has a {replaced[0]} of its own, which may do something else than its layers: take it out, or "
                "give the export of a module, torch.export.export(module, (states,))"
            )


def real_values(tensor: Any, name: str) -> FloatArray:
    """Return a tensor's numbers as float64, or raise InvalidNetworkError where it is no dense array of real numbers."""
    _require_numbers(tensor, name)
    if not tensor.is_floating_point():
        raise InvalidNetworkError(f"{name} is of type {tensor.dtype}, expected real floating-point numbers")
    values: FloatArray = tensor.detach().cpu().double().resolve_neg().numpy()
    return values


def _require_numbers(tensor: Any, name: str) -> None:
    """Raise InvalidNetworkError unless the tensor holds, in its own memory, all the numbers that it shows."""
    import torch

    if type(tensor) not in (torch.Tensor, torch.nn.Parameter):
        what = f"is a {type(tensor).__name__}"
    elif tensor.device.type == "meta":
        what = "is on the device 'meta' and has no numbers"
    elif tensor.is_nested or tensor.layout is not torch.strided:
        what = f"has the layout {'nested' if tensor.is_nested else tensor.layout}"
    elif tensor.is_complex():
        what = f"holds complex numbers ({tensor.dtype})"
    elif tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        what = f"is expanded: its shape is {tuple(tensor.shape)}, {tensor.untyped_storage().nbytes()} bytes are stored"
    else:
        return
    raise InvalidNetworkError(f"{name} {what}, expected a dense tensor with a real number of its own for every entry")


def _copy(module: Any) -> Any:
    """Return a copy in evaluation mode and on the processor, so that the caller's module stays as it is."""
    import torch

    # What a hook computed (weight_norm) cannot be copied together with the way it was computed.
    computed = {
        id(value): value.detach().clone()
        for part in module.modules()
        for value in vars(part).values()
        if isinstance(value, torch.Tensor) and not value.is_leaf
    }
    try:
        return copy.deepcopy(module, computed).cpu().eval()
    except Exception as error:  # foreign modules and hooks can fail in any way
        raise InvalidNetworkError(
            f"the module cannot be copied: {error}; give a Sequential of plain layers, or the export of the module, "
            "torch.export.export(module, (states,))"
        ) from error


def sections_of_export(file: Path | bytes) -> tuple[Sections, Callable[[FloatArray], NDArray[np.float64]]]:
    """Return the sections of an archive of `torch.export.save`, and what the whole answers on one state.

    `otr.from_torch` documents what is read, and errors.
    """
    export = read_export(file)
    if recurrent := [call for call in export.calls if re.match(r"torch\.ops\.aten\.(lstm|gru|rnn)", call.target)]:
        raise InvalidNetworkError(MEMORY.format(recurrent[0]))
    calls = [call for call in export.calls if not _is_check(call)]
    functions = [_function(call) for call in calls]
    nodes = [_node(call, function) for call, function in zip(calls, functions, strict=True)]
    constants: dict[str, Any] = {str(name): tensor for name, tensor in export.tensors.items()}
    sections = Sections(export.input_name, export.input_shape, nodes, constants, export.output_name)
    return sections, _whole(export, sections.input.shape, list(zip(calls, functions, strict=True)), export.output_name)


def oracle_of_export(file: Path | bytes) -> Oracle:
    """Return the policy of an archive of `torch.export.save`: its ReLU network, or else what torch answers."""
    content = file if isinstance(file, bytes) else file.read_bytes()
    sections, answer = sections_of_export(file)
    try:
        return policy_of(sections, decides=True, answer=answer)
    except InvalidNetworkError as error:
        export = read_export(content)
        calls = [(call, _function(call)) for call in export.calls if not _is_check(call)]
        return black_box(sections, partial(_runtime, export, sections.input.shape, calls), str(error), content, ".pt2")


def _runtime(
    export: Export, shape: tuple[int, ...], calls: list[tuple[Call, Callable[..., Any]]], value: str
) -> tuple[Function, Function]:
    """Return what torch makes of a value of the program, for one state and for several."""
    import torch

    one = _whole(export, shape, calls, value)

    def several(X: FloatArray) -> NDArray[Any]:
        answer = torch.vmap(_program(export, shape, calls, value))
        return np.asarray(answer(torch.tensor(X)).detach().numpy())

    return one, several


def _is_check(call: Call) -> bool:
    return re.match(r"torch\.ops\.aten\.(_assert|sym_constrain)", call.target) is not None


def _function(call: Call) -> Callable[..., Any]:
    """Return one of torch's pure operators on tensors, or Python's arithmetic of sizes."""
    import torch
    from torch._decomp import decomposition_table

    if call.target in _OF_SIZES:
        return _OF_SIZES[call.target]
    match = re.fullmatch(r"torch\.ops\.aten\.(\w+)\.(\w+)", call.target)
    found = getattr(getattr(torch.ops.aten, match[1], None), match[2], None) if match else None
    pure = getattr(getattr(torch.ops.aten, re.sub("(_|_copy)$", "", match[1]), None), match[2], None) if match else None
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
        values: dict[str, Any] = {
            name: _tensor(value, copied=_changes(function)) for name, value in zip(names, operands, strict=True)
        }
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


def _program(
    export: Export, shape: tuple[int, ...], calls: list[tuple[Call, Callable[..., Any]]], value: str
) -> Callable[[Any], Any]:
    """Return the program from one state, a tensor, to one of its values."""
    import torch

    copied = any(_changes(function) for _, function in calls)

    def answer(state: Any) -> Any:
        values: dict[str, Any] = {name: _tensor(tensor, copied=copied) for name, tensor in export.tensors.items()}
        values[export.input_name] = state.reshape(shape)
        for call, function in calls:
            made = _results(_called(call, function, values, torch.device("cpu")))
            values.update(zip(map(Name, call.outputs), made, strict=False))
        return values[value]

    return answer


def _whole(
    export: Export, shape: tuple[int, ...], calls: list[tuple[Call, Callable[..., Any]]], value: str
) -> Callable[[FloatArray], NDArray[np.float64]]:
    """Return the program on one state, where operators in place change what others read, too."""
    answer = _program(export, shape, calls, value)
    return lambda state: np.asarray(_array(answer(_tensor(state, copied=True)))).ravel()


def _results(made: Any) -> Sequence[Any]:
    return made if isinstance(made, list | tuple) else [made]


def _changes(function: Callable[..., Any]) -> bool:
    """Return whether an operator may change its arguments in place."""
    return bool(getattr(getattr(function, "_schema", None), "is_mutable", False))


def _tensor(value: Any, *, copied: bool) -> Any:
    """Return an array's numbers as a tensor, copied where an operator may change it, and a size as it is."""
    import torch

    if not isinstance(value, np.ndarray):
        return value
    return torch.tensor(value) if copied or not value.flags.writeable else torch.from_numpy(value)


def _array(value: Any) -> Any:
    import torch

    if not torch.is_tensor(value):
        return value
    kept = value.dtype in (torch.float16, torch.float32, torch.float64) or not value.is_floating_point()
    return (value if kept else value.double()).detach().numpy()
