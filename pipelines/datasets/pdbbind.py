"""PDBbind as LCN's repository has it: a gzip'd pickle of six arrays, read without running anything that is in it.

The order is train_x, train_y, valid_x, valid_y, test_x, test_y; a row of x has 2,052 features, y is one number a row.
"""

import io
import pickle
from typing import Any

import numpy as np

from pipelines.datasets.catalogue import PDBBIND
from pipelines.datasets.dataset import PARTS, Dataset, Part
from pipelines.datasets.download import BROKEN_GZIP, LARGEST_BYTES, gunzip, read
from pipelines.errors import PipelineError

N_FEATURES = 2052
KNOWN = {("numpy._core.multiarray", "_reconstruct"), ("numpy._core.numeric", "_frombuffer"), ("numpy", "ndarray"),
         ("numpy", "dtype"), ("_codecs", "encode")}  # fmt: skip


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
    """Return the six arrays of a pickled tuple or list, of whose names those that arrays need are looked up.

    Raises:
        ValueError: says what was found.
    """
    try:
        found = _ArraysOnly(io.BytesIO(content)).load()
    except Exception as error:  # a pickle from elsewhere can fail in any way
        raise ValueError(f"it is no pickle of plain numeric arrays: {error}") from error
    if not isinstance(found, tuple | list) or len(found) != 2 * len(PARTS):
        raise ValueError(f"it holds a {type(found).__name__} and not six arrays")
    if not all(isinstance(item, np.ndarray) and item.dtype.kind in "fiub" for item in found):
        raise ValueError("it holds something else than six arrays")
    return list(found)


def _part(x: np.ndarray, y: np.ndarray) -> Part:
    if x.ndim != 2 or x.shape[1] != N_FEATURES or y.shape not in ((len(x),), (len(x), 1)):
        raise ValueError(f"x is {x.shape} and y is {y.shape}; (n, {N_FEATURES}) and (n,) were expected")
    part = Part(x.astype(np.float32), y.astype(np.float64).reshape(-1, 1))
    if not (np.isfinite(part.X).all() and np.isfinite(part.Y).all()):
        raise ValueError("some of its numbers are not finite")
    return part


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        renamed = module.replace("numpy.core", "numpy._core")  # in NumPy 2
        if (renamed, name) not in KNOWN:
            raise pickle.UnpicklingError(f"{module}.{name} is refused")
        return super().find_class(renamed, name)
