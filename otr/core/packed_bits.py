"""Rows of bits packed into 64-bit words, so that millions of activation patterns are sorted and counted fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, IntArray

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
