"""Torch modules: a Sequential's layers one by one, any other as `torch.export` writes it, compared with the module."""

from __future__ import annotations

import copy
import inspect
import io
import warnings
from collections.abc import Iterable
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.smooth_network import Oracle
from otr.errors import InvalidNetworkError
from otr.importers.assembly import policy_of
from otr.importers.sections import Sections
from otr.importers.torch_nodes import sections_of_export

if TYPE_CHECKING:
    import torch

_CALLS = ("__call__", "_call_impl", "_wrapped_call_impl")  # by which torch runs a module's forward


def policy_of_module(module: torch.nn.Module, head: Head | None) -> Oracle:
    """Return the network of a module; `otr.from_torch` documents arguments and errors."""
    import torch

    for name, tensor in chain(module.named_parameters(), module.named_buffers()):
        _require_numbers(tensor, f"tensor {name!r}")
    refuse_changes(module, "module")
    linear = next((part for part in module.modules() if isinstance(part, torch.nn.Linear)), None)
    if linear is None:
        raise InvalidNetworkError(
            "there is no Linear layer, which would say how many inputs a state has; give the export of the module, "
            "torch.export.export(module, (states,))"
        )
    copied = _copy(module)
    layers = list(_flat_layers(copied, "module"))
    if not all(type(layer).__module__.startswith("torch.nn.") for _, layer in layers):
        sections, answer = sections_of_export(
            _exported(copied, torch.zeros(1, linear.in_features, dtype=linear.weight.dtype))
        )
        return policy_of(sections, head, answer=answer)
    copied.double()
    steps = [(f"{where} ({type(layer).__name__})", partial(_run, layer)) for where, layer in layers]
    sections = Sections.of_steps(steps, linear.in_features)
    return policy_of(sections, head, answer=lambda state: _run(copied, state[None]).ravel())


def _exported(module: Any, state: Any) -> bytes:
    """Return the bytes of a module's export."""
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            written = io.BytesIO()
            torch.export.save(torch.export.export(module, (state,)), written)
    except Exception as error:  # foreign code can fail in any way
        raise InvalidNetworkError(
            f"the module cannot be exported for a state of {state.numel()} inputs ({str(error).strip()[:300]}); give "
            "torch.export.export(module, (states,))"
        ) from error
    return written.getvalue()


def _run(module: Any, states: FloatArray) -> NDArray[Any]:
    import torch

    with torch.no_grad():
        return np.asarray(module(torch.tensor(states)).detach().cpu().numpy())


def _flat_layers(module: Any, name: str) -> Iterable[tuple[str, Any]]:
    """Yield (position, layer) of nested Sequentials in order."""
    import torch

    if isinstance(module, torch.nn.Sequential) and type(module).forward is torch.nn.Sequential.forward:
        for position, child in enumerate(module):  # named_children() leaves out a layer that stands there twice
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
