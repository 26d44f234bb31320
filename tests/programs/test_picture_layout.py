from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otr.programs.picture.layout import tidy_layout

GAP = 10.0


def random_shape(rng: np.random.Generator, n_splits: int) -> list[list[int]]:
    children: list[list[int]] = [[]]
    ends = [0]
    for _ in range(n_splits):
        box = ends.pop(rng.integers(len(ends)))
        children[box] = [len(children), len(children) + 1]
        ends += children[box]
        children += [[], []]
    return children


@given(st.integers(0, 2**32 - 1), st.integers(0, 40))
def test_boxes_of_a_depth_never_overlap_and_parents_are_centred(seed: int, n_splits: int) -> None:
    rng = np.random.default_rng(seed)
    children = random_shape(rng, n_splits)
    widths = rng.uniform(20, 200, len(children)).tolist()
    x = tidy_layout(children, widths, GAP)
    level = [0]
    while level:
        for before, after in pairwise(level):
            assert x[before] + widths[before] / 2 + GAP <= x[after] - widths[after] / 2 + 1e-9
        for box in level:
            if children[box]:
                assert x[box] == pytest.approx(np.mean([x[child] for child in children[box]]))
        level = [child for box in level for child in children[box]]
    assert min(x[box] - widths[box] / 2 for box in range(len(x))) == pytest.approx(0)


def test_by_hand() -> None:
    assert tidy_layout([[]], [30.0], GAP) == [15.0]
    # The wide box below pushes its parent, not the leaf of another depth.
    assert tidy_layout([[1, 2], [], [3, 4], [], []], [20.0, 20.0, 20.0, 20.0, 60.0], GAP) == [25, 10, 40, 15, 65]
