"""DAgger's aggregated data: growing arrays in files, memory-mapped, of which a committed number of rows counts."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from otr.core.arrays import FloatArray
from otr.errors import ArtefactError

__all__ = ["GrowingArray"]


class GrowingArray:
    """A float64 array (n, width) in a raw file; rows are appended behind those that the caller has committed.

    The file does not know how many rows count: the caller does, and a killed append leaves rows that the next one
    overwrites.

    Args:
        path: the file, made when the first rows come.
        width: number of columns.
    """

    def __init__(self, path: Path, width: int) -> None:
        self._path = path
        self._row_bytes = 8 * width
        self._width = width

    def append(self, n_rows: int, rows: FloatArray) -> int:
        """Put `rows` (m, width) behind the first `n_rows`, on the disk itself; return the new number of rows.

        Raises:
            ArtefactError: the file holds fewer than `n_rows` rows.
        """
        if rows.ndim != 2 or rows.shape[1] != self._width:
            raise ValueError(f"rows have shape {rows.shape}, expected (m, {self._width})")
        self._check(n_rows)
        with self._path.open("r+b" if self._path.exists() else "xb") as file:
            file.truncate(n_rows * self._row_bytes)
            file.seek(0, os.SEEK_END)
            file.write(np.ascontiguousarray(rows, dtype="<f8").tobytes())
            file.flush()
            os.fsync(file.fileno())
        return n_rows + len(rows)

    def view(self, n_rows: int) -> FloatArray:
        """Return the first `n_rows` rows, memory-mapped and read-only.

        Raises:
            ArtefactError: the file holds fewer.
        """
        self._check(n_rows)
        return np.memmap(self._path, dtype="<f8", mode="r", shape=(n_rows, self._width))

    def _check(self, n_rows: int) -> None:
        size = self._path.stat().st_size if self._path.exists() else 0
        if size < n_rows * self._row_bytes:
            raise ArtefactError(
                f"{self._path} holds {size // self._row_bytes} rows, {n_rows} were committed; "
                f"delete {self._path.parent} to begin again"
            )
