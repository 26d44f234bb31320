"""Stacks of tensors, one a network: a network's results are bit-identical whatever networks are batched with it.

Three things would make its rounding depend on the others, and are avoided here:

* A batched product chooses its kernel by the number of matrices: there is one product a network instead.
* MKL sums in an order that depends on where a matrix begins: every network begins at a multiple of 64 bytes.
* A vectorised loop computes the remainder with other instructions: a gap between networks ends the loop, so that
  it never runs from one into the next; rows with their gaps are a multiple of ROW_MULTIPLE, which leaves no remainder.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

ROW_MULTIPLE = 64  # elements: 64 bytes or more, and the width of a vectorised loop


def padded(n_elements: int) -> int:
    """Return the size of `n_elements` with the gap after them."""
    return (n_elements // ROW_MULTIPLE + 1) * ROW_MULTIPLE


def new_stack(n: int, *shape: int) -> Tensor:
    """Return zeros (n, *shape) with a gap after each of the n."""
    size = math.prod(shape)
    return torch.zeros(n, padded(size))[:, :size].view(n, *shape)


def new_flat(n: int, shapes: Sequence[Sequence[int]]) -> tuple[Tensor, list[Tensor]]:
    """Return zeros (n, padded), and stacks (n, *shape) in them one after another, with gaps as in `new_stack`."""
    sizes = [math.prod(shape) for shape in shapes]
    flat = torch.zeros(n, sum(map(padded, sizes)))
    rows = torch.split(flat, [padded(size) for size in sizes], dim=1)
    return flat, [row[:, :size].view(n, *shape) for row, size, shape in zip(rows, sizes, shapes, strict=True)]


def multiply(left: Tensor, right: Tensor, out: Tensor) -> Tensor:
    """Write left[i] @ right[i] into out[i] for each network i of stacks (or transposed views) and return `out`."""
    for one_left, one_right, one_out in zip(left.unbind(), right.unbind(), out.unbind(), strict=True):
        torch.mm(one_left, one_right, out=one_out)
    return out
