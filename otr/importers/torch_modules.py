"""Torch modules of Linear, ReLU and LeakyReLU layers, read layer by layer and compared with what the module answers."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import TanhBox
from otr.core.network import ReluNetwork
from otr.errors import InvalidNetworkError
from otr.importers.chain import DECIDED_BY, RELU_REMEDY, TRAIN_RELU, Chain, mappable, naming

if TYPE_CHECKING:
    import torch

_NOTHING = ("Flatten", "Identity", "Dropout")  # is what these do to a vector at inference
_LAYERS = ("Linear", "ReLU", "LeakyReLU", "Tanh", "Sigmoid", "Softmax", "LogSoftmax")
_CALLS = ("__call__", "_call_impl", "_wrapped_call_impl")  # by which torch runs a module's forward
_PROBES = 64  # states of each magnitude
_MAGNITUDES = (1e-3, 1.0, 1e3, 1e6)
_LIKELY_CAUSE = "a Softmax over another axis, or a Flatten of the states, may be the cause: take it out"
_ROUNDING = 1e-12  # of the size of a sum's terms; float64 in networks of a thousand neurons stays below


def network_of_module(module: torch.nn.Module, head: Head | None) -> ReluNetwork:
    """Return the network of a module's layers; `otr.from_torch` documents arguments and errors."""
    list(flat_layers(module, "module"))  # layers of other kinds are refused by name before anything is copied
    for name, tensor in chain(module.named_parameters(), module.named_buffers()):
        _require_numbers(tensor, f"tensor {name!r}")
    refuse_changes(module, "module")
    copied = _float64_copy(module)
    layers = list(flat_layers(copied, "module"))
    last = _kind(layers[-1][1]) if layers else ""
    if last == "Tanh":
        if head not in (None, TanhBox(-1.0, 1.0)):
            raise InvalidNetworkError(f"head is {head!r}, the module ends in Tanh: TanhBox(-1, 1); leave head out")
        head = TanhBox(-1.0, 1.0)
    elif not _is_decided_by(last, head):
        last = ""
    network = network_of_layers(layers[:-1] if last else layers, head)
    _require_same_answers(copied, network, layers, last)
    return network


def flat_layers(module: Any, name: str) -> Iterable[tuple[str, Any]]:
    """Yield (position, layer) of nested Sequentials in order, without the layers that do nothing at inference."""
    import torch

    if isinstance(module, torch.nn.Sequential):
        for position, child in enumerate(module):  # named_children() leaves out a layer that stands there twice
            yield from flat_layers(child, f"{name}[{position}]")
    elif _kind(module) not in _NOTHING:
        if not _kind(module):
            raise InvalidNetworkError(f"{name} is {module}; {_remedy('')}")
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
        if isinstance(part, torch.nn.Sequential) and type(part).forward is not torch.nn.Sequential.forward:
            replaced.append("forward")
        if replaced:
            raise InvalidNetworkError(
                f"{where} has a {replaced[0]} of its own, which may do something else than its layers: take it out, or "
                "give the export of a module, torch.export.export(module, (states,))"
            )


def network_of_layers(layers: Sequence[tuple[str, Any]], head: Head | None) -> ReluNetwork:
    """Return the network of (position, layer) pairs: Linear, ReLU and LeakyReLU."""
    first = next((layer for _, layer in layers if _kind(layer) == "Linear"), None)
    if first is None:
        raise InvalidNetworkError("there is no Linear layer; give a Sequential of Linear, ReLU and LeakyReLU layers")
    chain = Chain((int(first.weight.shape[1]),))
    for position, layer in layers:
        if _kind(layer) == "Linear":
            W, b = _affine(position, layer)
            with naming(position):
                chain = chain.linear(W, b)
        elif _kind(layer) in ("ReLU", "LeakyReLU"):
            with naming(f"{position} is {layer}, which"):
                chain = chain.activation(float(getattr(layer, "negative_slope", 0.0)))
        else:
            remedy = _remedy(_kind(layer))
            if remedy == RELU_REMEDY and any(_kind(other) in ("ReLU", "LeakyReLU") for _, other in layers):
                remedy = TRAIN_RELU  # a network of units of two kinds cannot be imitated
            raise InvalidNetworkError(f"{position} is {layer}; {remedy}")
    return mappable(chain.network(head))


def real_values(tensor: Any, name: str) -> FloatArray:
    """Return a tensor's numbers as float64, or raise InvalidNetworkError where it is no dense array of real numbers."""
    _require_numbers(tensor, name)
    if not tensor.is_floating_point():
        raise InvalidNetworkError(f"{name} is of type {tensor.dtype}, expected real floating-point numbers")
    values: FloatArray = tensor.detach().cpu().double().resolve_neg().numpy()
    return values


def probe_states(n_inputs: int) -> FloatArray:
    """Return fixed states of several magnitudes, and the origin: (n, n_inputs)."""
    rng = np.random.default_rng(0)
    states = [magnitude * rng.standard_normal((_PROBES, n_inputs)) for magnitude in _MAGNITUDES]
    return np.concatenate((np.zeros((1, n_inputs)), *states))


def reach(affine: Iterable[tuple[FloatArray, FloatArray]], states: FloatArray) -> FloatArray:
    """Return the size (n, o) of the terms that make up each output, to which rounding is in proportion."""
    size = np.abs(states)
    for W, b in affine:
        size = size @ np.abs(W).T + np.abs(b)
    return size


def _kind(layer: Any) -> str:
    """Return the name of torch's kind of layer whose `forward` the layer runs, or "" where a subclass changes it."""
    import torch

    for name in (*_NOTHING, *_LAYERS):
        kind = getattr(torch.nn, name)
        if isinstance(layer, kind) and type(layer).forward is kind.forward:
            return name
    return ""


def _is_decided_by(kind: str, head: Head | None) -> bool:
    """Return whether `head` answers the same before a last layer of this kind as after it."""
    return head is not None and head == DECIDED_BY.get(kind)


def _remedy(kind: str) -> str:
    return {
        "Sigmoid": "as the last layer it needs head=otr.Sign() (label 1 where its input is above zero)",
        "Softmax": "as the last layer it needs head=otr.Argmax() (the label with the largest input)",
        "LogSoftmax": "as the last layer it needs head=otr.Argmax() (the label with the largest input)",
        "Tanh": RELU_REMEDY,
    }.get(kind, "only Linear, ReLU and LeakyReLU layers, with torch's own forward, can be mapped to a tree")


def _affine(position: str, layer: Any) -> tuple[FloatArray, FloatArray]:
    W = real_values(layer.weight, f"{position}.weight")
    return W, np.zeros(len(W)) if layer.bias is None else real_values(layer.bias, f"{position}.bias")


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


def _float64_copy(module: Any) -> Any:
    """Return a copy in evaluation mode, float64 and on the processor, so that the caller's module stays as it is."""
    import torch

    # What a hook computed (weight_norm) cannot be copied together with the way it was computed.
    computed = {
        id(value): value.detach().clone()
        for part in module.modules()
        for value in vars(part).values()
        if isinstance(value, torch.Tensor) and not value.is_leaf
    }
    try:
        return copy.deepcopy(module, computed).to(device="cpu", dtype=torch.float64).eval()
    except Exception as error:  # foreign modules and hooks can fail in any way
        raise InvalidNetworkError(
            f"the module cannot be copied, so it cannot be compared with its layers: {error}; "
            "give a Sequential of plain layers without hooks"
        ) from error


def _require_same_answers(module: Any, network: ReluNetwork, layers: Sequence[tuple[str, Any]], last: str) -> None:
    """Raise InvalidNetworkError where the module answers otherwise than the network and its `last` layer, if any."""
    import torch

    states = probe_states(network.n_inputs)
    make_last = getattr(torch.nn, last or "Identity")
    expected = make_last(dim=-1) if "Softmax" in last else make_last()
    expected = expected(torch.from_numpy(network.forward(states))).numpy()
    try:
        with torch.no_grad():
            answers = module(torch.from_numpy(states.copy())).cpu().numpy()
    except Exception as error:  # foreign code can fail in any way
        raise InvalidNetworkError(
            f"the module cannot be run on {len(states)} states of {network.n_inputs} inputs in float64: {error}; "
            f"{_LIKELY_CAUSE}"
        ) from error
    if answers.shape != expected.shape:
        raise InvalidNetworkError(
            f"the module answers {len(states)} states with shape {answers.shape}, its layers with "
            f"{expected.shape}; {_LIKELY_CAUSE}"
        )
    with np.errstate(invalid="ignore"):  # both may be infinite
        differences = np.where(answers == expected, 0.0, np.abs(answers - expected))
    affine = [_affine(position, layer) for position, layer in layers if _kind(layer) == "Linear"]
    if not (differences <= _ROUNDING * reach(affine, states).max(axis=1, keepdims=True)).all():
        i = int(np.argmax(np.nan_to_num(differences, nan=np.inf).max(axis=1)))
        raise InvalidNetworkError(
            f"the module answers otherwise than its layers: in state {states[i].tolist()} it gives "
            f"{answers[i].tolist()}, its layers {expected[i].tolist()} (the largest difference of {len(states)} "
            f"states: {differences[i].max():g}); {_LIKELY_CAUSE}"
        )
