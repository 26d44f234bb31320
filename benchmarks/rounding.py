"""Trees whose coefficients are rounded to a few bits over a box, as fixed-point controllers have them."""

import numpy as np

import otr
from otr.core.arrays import FloatArray


def rounded_tree(tree: otr.ObliqueTree, low: FloatArray, high: FloatArray, bits: int) -> otr.ObliqueTree:
    """Return a tree with each test and each row of a leaf's map on a grid of its own over a box (d,).

    In coordinates that are from -1 to 1 over the box, the largest number of a row is ``2**(bits - 1) - 1`` grid steps.
    """

    def on_grid(linear: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
        half, middle = (high - low) / 2, (high + low) / 2
        rows = np.concatenate((linear * half, (offsets + linear @ middle)[..., None]), axis=-1)
        step = np.abs(rows).max(axis=-1, keepdims=True) / (2 ** (bits - 1) - 1)
        rows = np.round(rows / np.where(step > 0, step, 1.0)) * step
        linear = rows[..., :-1] / half
        return linear, rows[..., -1] - linear @ middle

    (P, v), (M, c) = on_grid(tree.P, tree.v), on_grid(tree.M, tree.c)
    return otr.ObliqueTree(tree.children_left, tree.children_right, P, v, M, c, labels=tree.labels, head=tree.head)
