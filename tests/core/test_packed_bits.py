import numpy as np
import pytest

from otr.core.packed_bits import count_rows, pack_rows, unpack_rows


@pytest.mark.parametrize("n_bits", [0, 1, 7, 8, 63, 64, 65, 128, 200])
def test_packing_keeps_rows_and_their_order(n_bits: int) -> None:
    rng = np.random.default_rng(n_bits)
    rows = rng.random((300, n_bits)) < 0.5
    rows = np.concatenate((rows, rows[:50]))
    words = pack_rows(rows)
    np.testing.assert_array_equal(unpack_rows(words, n_bits), rows)
    distinct, counts = count_rows(words, np.ones(len(rows), dtype=np.int64))
    expected, expected_counts = np.unique(rows, axis=0, return_counts=True) if n_bits else (rows[:1], [350])
    np.testing.assert_array_equal(unpack_rows(distinct, n_bits), expected)
    np.testing.assert_array_equal(counts, expected_counts)
