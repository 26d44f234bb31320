"""Types of arrays, the checks of states that every part of the library shares, and rows of bits packed into words."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def as_states(X: ArrayLike, n_inputs: int) -> FloatArray:
    """Return `X` as float64 (n, n_inputs) or, for a single state, (n_inputs,); raise ValueError for other shapes."""
    states: FloatArray = np.asarray(X, dtype=np.float64)
    if states.ndim not in (1, 2) or states.shape[-1] != n_inputs:
        raise ValueError(
            f"states have shape {states.shape}, expected (n, {n_inputs}) or ({n_inputs},): "
            f"one column for each of the {n_inputs} inputs"
        )
    return states


def as_batch(X: ArrayLike, n_inputs: int) -> FloatArray:
    """Return `X` as float64 of shape (n, n_inputs); a single state becomes a batch of one."""
    return np.atleast_2d(as_states(X, n_inputs))


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view of `array` that refuses assignment."""
    view = array.view()
    view.flags.writeable = False
    return view


def with_read_only_arrays(state: dict[str, Any]) -> dict[str, Any]:
    """Return attributes, as a copy or a pickle has them, whose arrays, also those in tuples, refuse assignment."""

    def locked(value: Any) -> Any:
        if type(value) is tuple:
            return tuple(map(locked, value))
        return read_only(value) if isinstance(value, np.ndarray) else value

    return {name: locked(value) for name, value in state.items()}


# (n, n_words); the first bit is the highest of the first word, so numeric order is the lexicographic order of bits.
PackedRows = NDArray[np.uint64]


def pack_rows(rows: BoolArray) -> PackedRows:
    """Return the rows (n, n_bits) as words (n, max(1, ceil(n_bits / 64)))."""
    n, n_bits = rows.shape
    n_words = max(1, -(-n_bits // 64))
    octets = np.zeros((n, 8 * n_words), dtype=np.uint8)
    octets[:, : -(-n_bits // 8)] = np.packbits(rows, axis=1)
    return octets.view(">u8").astype(np.uint64)


def unpack_rows(words: PackedRows, n_bits: int) -> BoolArray:
    """Return the rows (n, n_bits) that `pack_rows` packed."""
    octets = words.astype(">u8").view(np.uint8)
    return np.unpackbits(octets, axis=1, count=n_bits).view(np.bool_)


def count_rows(words: PackedRows, counts: IntArray) -> tuple[PackedRows, IntArray]:
    """Return the distinct rows in ascending order, and the sum of `counts` (n,) over each one's occurrences."""
    if not len(words):
        return words, counts
    # Words of lower significance come first in lexsort's keys.
    order = np.argsort(words[:, 0]) if words.shape[1] == 1 else np.lexsort(words.T[::-1])
    words, counts = words[order], counts[order]
    is_first = np.ones(len(words), dtype=np.bool_)
    is_first[1:] = (words[1:] != words[:-1]).any(axis=1)
    first = np.flatnonzero(is_first)
    return words[first], np.add.reduceat(counts, first)
