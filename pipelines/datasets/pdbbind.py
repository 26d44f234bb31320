"""PDBbind as LCN's repository has it: a gzip'd pickle of six arrays, read without running anything that is in it.

The order is train_x, train_y, valid_x, valid_y, test_x, test_y; a row of x has 2,052 features, y is one number a row.
"""

import io
import pickle
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from pipelines.datasets.catalogue import PDBBIND
from pipelines.datasets.dataset import PARTS, Dataset, Part
from pipelines.datasets.download import BROKEN_GZIP, LARGEST_BYTES, gunzip, read
from pipelines.errors import PipelineError

N_FEATURES = 2052


def load_pdbbind() -> Dataset:
    """Return PDBbind; raises as `download.read`, and PipelineError where it holds something else than arrays."""
    packed = read(PDBBIND)
    try:
        arrays = unpickle_arrays(gunzip(packed, LARGEST_BYTES))
        parts = {part: _part(*arrays[2 * i : 2 * i + 2]) for i, part in enumerate(PARTS)}
    except (*BROKEN_GZIP, ValueError) as error:
        raise PipelineError(
            f"{PDBBIND.path} has the right hash and cannot be read: {error}\nPlease report it; nothing of it was run."
        ) from error
    names = tuple(f"feature{i}" for i in range(N_FEATURES))
    return Dataset("pdbbind", "regression", ("affinity",), names, *parts.values())


def unpickle_arrays(content: bytes) -> list[np.ndarray]:
    """Return the six arrays of a pickled tuple or list; anything but plain numeric arrays is refused.

    The names in the pickle are never looked up: those that a numpy array needs are answered with stand-ins of ours,
    which take shapes, number types and bytes; every other name ends the reading.

    Raises:
        ValueError: says what was found.
    """
    try:
        found = _ArraysOnly(io.BytesIO(content)).load()
    except Exception as error:  # a pickle from elsewhere can fail in any way
        raise ValueError(f"it is no pickle of plain numeric arrays: {error}") from error
    if not isinstance(found, tuple | list) or len(found) != 2 * len(PARTS):
        raise ValueError(f"it holds a {type(found).__name__} and not six arrays")
    arrays = [item.array if isinstance(item, _Array) else None for item in found]
    if any(array is None for array in arrays):
        raise ValueError("it holds something else than six arrays")
    return [array for array in arrays if array is not None]


def _part(x: np.ndarray, y: np.ndarray) -> Part:
    if x.ndim != 2 or x.shape[1] != N_FEATURES or y.shape not in ((len(x),), (len(x), 1)):
        raise ValueError(f"x is {x.shape} and y is {y.shape}; (n, {N_FEATURES}) and (n,) were expected")
    part = Part(x.astype(np.float32), y.astype(np.float64).reshape(-1, 1))
    if not (np.isfinite(part.X).all() and np.isfinite(part.Y).all()):
        raise ValueError("some of its numbers are not finite")
    return part


class _Array:
    """Stands for an array while it is read."""

    __slots__ = ("array",)

    def __init__(self, array: np.ndarray | None = None) -> None:
        self.array = array

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, is_fortran, content = state
        self.array = _numbers(content, dtype, shape, "F" if is_fortran else "C")


class _Dtype:
    """Stands for a number type while it is read."""

    __slots__ = ("dtype",)

    def __init__(self, code: Any, *_: Any) -> None:
        if not isinstance(code, str) or not re.fullmatch(r"[<>=|]?(f[248]|[iu][1248]|b1)", code):
            raise pickle.UnpicklingError(f"the number type {code!r}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if state[1] not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"the byte order {state[1]!r}")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Callable:
    """Stands for a function or class that a pickle names. Nothing can be set on it."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __call__(self, *arguments: Any) -> Any:
        return self._make(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("an attempt to change a function")


def _numbers(content: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    if not isinstance(content, bytes | bytearray) or not isinstance(dtype, _Dtype) or order not in ("C", "F"):
        raise pickle.UnpicklingError("an array that is not made of bytes")
    return np.frombuffer(content, dtype=dtype.dtype).reshape(shape, order=order)


def _latin1(text: Any, encoding: Any) -> bytes:
    """Return the bytes that pickles of protocol 2 keep as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"the encoding {encoding!r}")
    return text.encode("latin1")


def _no_call(*_: Any) -> None:
    raise pickle.UnpicklingError("a call of numpy.ndarray")


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy._core", "numpy.core")  # renamed in NumPy 2
        known: dict[tuple[str, str], Callable[..., Any]] = {
            ("numpy.core.multiarray", "_reconstruct"): lambda *_: _Array(),
            ("numpy.core.numeric", "_frombuffer"): lambda *arguments: _Array(_numbers(*arguments)),
            ("numpy", "ndarray"): _no_call,
            ("numpy", "dtype"): _Dtype,
            ("_codecs", "encode"): _latin1,
        }
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"{module}.{name} is refused")
        return _Callable(known[module, name])
