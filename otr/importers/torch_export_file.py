"""The nodes and tensors of a torch export, read from its JSON and raw bytes, without torch and its pickles."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.errors import ArtefactError, InvalidNetworkError
from otr.files.zip_members import read_members

_LIMIT_BYTES = 2**26  # of the archive: sixteen million numbers
_LIMIT_TEXT_BYTES = 2**24  # of its JSON, which takes twenty times as much memory
_REMEDY = "write it with torch 2.9 or newer: torch.export.save(torch.export.export(module, (states,)), 'policy.pt2')"
# Codes of torch's types in the JSON (torch._export.serde.schema.ScalarType); bfloat16 is the upper half of a float32.
_FLOATS = {6: "<f2", 7: "<f4", 8: "<f8"}
_BFLOAT16 = 13


class Name(str):
    """The name of a value of the graph, where a number or a text could be, too."""


class Type(int):
    """The code of a type of numbers."""


@dataclass(frozen=True)
class Call:
    """One operation of the graph.

    Attributes:
        target: as the file has it, such as "torch.ops.aten.linear.default".
        arguments: by name: a `Name`, a `Type`, a number, a text, a list of them, or None.
        outputs: names of the values that it makes.
    """

    target: str
    arguments: dict[str, Any]
    outputs: tuple[str, ...]

    def __str__(self) -> str:
        operator = self.target.removeprefix("torch.ops.aten.").partition(".")[0]
        return f"node {next(iter(self.outputs), '')!r} ({operator})"


@dataclass(frozen=True)
class Export:
    """What is needed of an exported program.

    Attributes:
        input_name, input_shape: of the states; a size that is not fixed is 0.
        output_name: of the answers.
        calls: in the order in which they are computed.
        tensors: parameters, buffers and constants, as float64, by their names in the graph.
    """

    input_name: Name
    input_shape: tuple[int, ...]
    output_name: Name
    calls: list[Call]
    tensors: dict[Name, FloatArray]


def read_export(file: Path | bytes) -> Export:
    """Return what is needed of an archive that `torch.export.save` wrote, or of its bytes.

    Raises:
        ArtefactError: the file is missing, too large, cut off, or no such archive.
        InvalidNetworkError: the program has several inputs or outputs, changes a value in two places, or has tensors
            that are not plain real numbers.
    """
    label = "the export" if isinstance(file, bytes) else str(file)
    members = _members(io.BytesIO(file) if isinstance(file, bytes) else file, label)
    model = _json(members, "models/model.json", label)
    try:
        return _export(model, members, label)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, StopIteration) as error:
        if isinstance(error, InvalidNetworkError):
            raise
        version = model.get("schema_version") if isinstance(model, dict) else None
        raise ArtefactError(
            f"{label} is an export in another form than is read here (version {version}, {type(error).__name__}: "
            f"{error}); {_REMEDY}"
        ) from error


def _members(file: Path | IO[bytes], label: str) -> dict[str, bytes]:
    """Return the archive's members by name, without the folder that it calls itself."""
    try:
        members = dict(read_members(file, label, limit_bytes=_LIMIT_BYTES))
    except FileNotFoundError as error:
        raise ArtefactError(f"{label} does not exist; give the path of a file that torch.export.save wrote") from error
    return {name.partition("/")[2]: content for name, content in members.items()}


def _json(members: dict[str, bytes], name: str, label: str) -> Any:
    if name not in members:
        raise ArtefactError(f"{label} holds no {name}, as an export of torch does; {_REMEDY}")
    if len(members[name]) > _LIMIT_TEXT_BYTES:
        raise ArtefactError(f"{name} in {label} has {len(members[name]):,} bytes, the limit is {_LIMIT_TEXT_BYTES:,}")
    try:
        return json.loads(members[name])
    except (ValueError, RecursionError) as error:
        raise ArtefactError(f"{label} cannot be read: {name} is no JSON ({error}); {_REMEDY}") from error


def _export(model: Any, members: dict[str, bytes], label: str) -> Export:
    if members["byteorder"].strip() != b"little":
        raise ArtefactError(f"{label} was written on a machine with another byte order; write it on another one")
    program = model["graph_module"]
    graph, signature = program["graph"], program["signature"]
    inputs = [spec["user_input"]["arg"] for spec in signature["input_specs"] if "user_input" in spec]
    outputs = signature["output_specs"]
    if len(inputs) != 1 or len(outputs) != 1 or "user_output" not in outputs[0]:
        raise InvalidNetworkError(
            f"the program reads {len(inputs)} inputs and makes {len(outputs)} results, expected one of each: the "
            "states and the actions; export a module that returns the actions alone, after module.eval()"
        )
    (answer,) = graph["outputs"]
    calls = [_call(node) for node in graph["nodes"]]
    input_name, output_name = Name(inputs[0]["as_tensor"]["name"]), Name(answer["as_tensor"]["name"])
    read = {name for call in calls for name in names_in(call.arguments)} | {output_name}
    tensors = _tensors(signature["input_specs"], read, members, label)
    sizes = graph["tensor_values"][input_name]["sizes"]
    shape = tuple(int(size.get("as_int", 0)) for size in sizes)
    return Export(input_name, shape, output_name, calls, tensors)


def names_in(value: Any) -> Iterator[Name]:
    """Yield the names of values in an argument, or in several."""
    if isinstance(value, Name):
        yield value
    elif isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from names_in(each)


def _call(node: dict[str, Any]) -> Call:
    outputs = [_argument(output) for output in node["outputs"]]
    arguments = {str(given["name"]): _argument(given["arg"]) for given in node["inputs"]}
    return Call(str(node["target"]), arguments, tuple(names_in(outputs)))


def _argument(argument: dict[str, Any]) -> Any:
    """Return a value of the graph as a `Name`, numbers as they are."""
    ((kind, value),) = argument.items()
    if kind in ("as_none", "as_device", "as_layout", "as_memory_format"):  # all is dense and on the processor
        return None
    if kind == "as_float":
        return float(value)  # infinity is a text
    if kind == "as_scalar_type":
        return Type(value)
    if kind == "as_tensor":
        return Name(value["name"])
    if kind == "as_tensors":
        return [Name(each["name"]) for each in value]
    if kind == "as_optional_tensors":
        return [_argument(each) for each in value]
    if kind in ("as_sym_int", "as_sym_float", "as_sym_bool"):
        return _size(value)
    if kind == "as_sym_ints":
        return [_size(size) for size in value]
    if kind in ("as_int", "as_ints", "as_floats", "as_bool", "as_bools", "as_string"):
        return value
    raise InvalidNetworkError(f"the program has an argument of the kind {kind!r}; export the module without it")


def _size(value: dict[str, Any]) -> Any:
    ((kind, size),) = value.items()
    return Name(size) if kind == "as_name" else size


def _tensors(specs: list[Any], read: set[Name], members: dict[str, bytes], label: str) -> dict[Name, FloatArray]:
    """Return the tensors whose names in the graph are among those `read`."""
    kept: dict[str, Any] = {}
    for folder, config in (("weights", "model_weights_config"), ("constants", "model_constants_config")):
        payloads = _json(members, f"data/{folder}/{config}.json", label)["config"]
        kept |= {name: (f"data/{folder}/{payload['path_name']}", payload) for name, payload in payloads.items()}
    tensors = {}
    for spec in specs:
        ((kind, about),) = spec.items()
        if kind == "user_input":
            continue
        if kind not in ("parameter", "buffer", "tensor_constant"):
            raise InvalidNetworkError(f"the program has a {kind} besides the states; export the module with only these")
        name = Name(about["arg"]["name"])
        if name in read:
            path, payload = kept[about[f"{kind}_name"]]
            tensors[name] = _tensor(about[f"{kind}_name"], members[path], payload)
    return tensors


def _tensor(name: str, content: bytes, payload: dict[str, Any]) -> FloatArray:
    """Return a tensor's numbers, which are in their storage's bytes with strides of their own."""
    if payload["use_pickle"]:
        raise InvalidNetworkError(f"the tensor {name!r} is kept as a pickle, which is not opened; use plain tensors")
    about = payload["tensor_meta"]
    shape, steps = ([size["as_int"] for size in about[key]] for key in ("sizes", "strides"))
    start = about["storage_offset"]["as_int"]
    stored = _stored(name, content, about["dtype"])
    last = start + sum((size - 1) * step for size, step in zip(shape, steps, strict=True))
    n_numbers = math.prod(shape)
    if n_numbers < 1 or min((*shape, *steps, start), default=0) < 0 or last >= len(stored) or n_numbers > len(stored):
        raise InvalidNetworkError(
            f"the tensor {name!r} shows the shape {tuple(shape)}, {len(stored)} numbers are stored; expected a number "
            "of its own for every entry"
        )
    bytes_a_step = [step * stored.itemsize for step in steps]
    shown = np.lib.stride_tricks.as_strided(stored[start:], shape, bytes_a_step, writeable=False)
    return shown.astype(np.float64)


def _stored(name: str, content: bytes, dtype: int) -> NDArray[Any]:
    """Return the numbers of a storage in their order."""
    if dtype == _BFLOAT16:
        return (np.frombuffer(content, "<u2").astype("<u4") << 16).view("<f4")
    if dtype not in _FLOATS:
        raise InvalidNetworkError(f"the tensor {name!r} is of torch's type {dtype}, expected real numbers (float32)")
    return np.frombuffer(content, _FLOATS[dtype])
