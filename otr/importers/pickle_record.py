"""Pickles read without running anything in them: a stand-in is kept for whatever they would make or call."""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from typing import Any

import numpy as np

from otr.core.arrays import FloatArray
from otr.errors import InvalidNetworkError


def record_of_pickle(content: bytes) -> Any:
    """Return what a pickle holds: numbers, texts and collections, and a `Record` of every other object.

    Raises:
        Exception: of any kind, as foreign pickles can fail in any way.
    """
    _refuse_traps(content)
    return _Recorder(io.BytesIO(content)).load()


class Record:
    """A stand-in for whatever a pickle makes or calls: records it, and does nothing."""

    name = ""

    def __new__(cls, *arguments: Any, **_: Any) -> Record:
        record = super().__new__(cls)
        record.arguments, record.state = arguments, None
        return record

    arguments: tuple[Any, ...]
    state: Any

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def ignore(self, *_: Any) -> None:
        """Add an element, as a list, a set or a dictionary would."""

    append = extend = add = __setitem__ = ignore


class _Recorder(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[Record]:
        """Return a stand-in; nothing is looked up."""
        return type("Record", (Record,), {"name": f"{module}.{name}"})


def _refuse_traps(content: bytes) -> None:
    """Raise UnpicklingError for what stand-ins cannot stop: registered extensions, and a memo that fills the memory."""
    for opcode, argument, _ in pickletools.genops(content):
        fills_memory = opcode.name.endswith("PUT") and int(argument or 0) > len(content)
        if fills_memory or opcode.name.startswith("EXT"):
            raise pickle.UnpicklingError(f"{opcode.name} {argument}")


def numbers(value: Any) -> FloatArray:
    """Return numbers, live or recorded, as float64."""
    if not isinstance(value, Record):
        given = np.asarray(value)
        if given.dtype.kind not in "fiu":
            raise InvalidNetworkError(f"found {value!r}, expected real numbers")
        return given.astype(np.float64)
    shape: Any = ()
    order: Any = "C"
    name = value.name.replace("numpy._core", "numpy.core")  # renamed in NumPy 2
    if name == "numpy.core.multiarray._reconstruct":
        _, shape, dtype, is_fortran, content = value.state
        order = "F" if is_fortran else "C"
    elif name == "numpy.core.numeric._frombuffer":
        content, dtype, shape, order = value.arguments
    elif name == "numpy.core.multiarray.scalar":
        dtype, content = value.arguments
    else:
        raise TypeError(f"{value.name} in place of numbers")
    return np.frombuffer(_bytes(content), dtype=_number_type(dtype)).reshape(shape, order=order).astype(np.float64)


def truth(value: Any) -> bool:
    """Return a truth value, live or recorded, of Python or of NumPy."""
    if isinstance(value, Record) and value.name.endswith("multiarray.scalar"):
        dtype, content = value.arguments
        if dtype.name != "numpy.dtype" or dtype.arguments[0] not in ("b1", "?"):
            raise TypeError(f"a truth value of the type {dtype.arguments!r}")
        return any(_bytes(content))
    if not isinstance(value, bool | np.bool_ | int):
        raise TypeError(f"{value!r} in place of a truth value")
    return bool(value)


def _number_type(record: Any) -> np.dtype[Any]:
    code = record.arguments[0]
    if (
        record.name != "numpy.dtype"
        or not isinstance(code, str)
        or not re.fullmatch(r"[<>=|]?(f[248]|[iu][1248])", code)
    ):
        raise TypeError(f"numbers of the type {code!r}")
    return np.dtype(code).newbyteorder(record.state[1])


def _bytes(content: Any) -> bytes:
    """Return bytes, which pickles of protocol 2 keep as text."""
    if isinstance(content, Record) and content.name == "_codecs.encode":
        text, encoding = content.arguments
        if encoding == "latin1":
            return str(text).encode("latin1")
    if not isinstance(content, bytes | bytearray):
        raise TypeError("numbers that are not made of bytes")
    return bytes(content)
