"""Where the boxes of a drawn binary tree go, so that nothing overlaps."""

from __future__ import annotations

from collections.abc import Sequence


def tidy_layout(children: Sequence[Sequence[int]], widths: Sequence[float], gap: float) -> list[float]:
    """Return the x of every box's centre, the leftmost edge at 0 (Reingold & Tilford 1981, with boxes of any width).

    Box 0 is the root; `children` holds no or two indices a box, above its own. Boxes of one depth keep the order of the
    tree and are at least `gap` apart; a parent is centred above its children, which are as close together as
    everything below them allows.
    """
    shifts = [0.0] * len(children)  # of a box from its parent
    contours: list[list[tuple[float, float]]] = [[] for _ in children]  # (left, right) by depth, seen from the box
    for box in reversed(range(len(children))):
        contours[box] = [(-widths[box] / 2, widths[box] / 2)]
        if children[box]:
            left, right = children[box]
            common = zip(contours[left], contours[right], strict=False)
            half = max(gap + end - start for (_, end), (start, _) in common) / 2
            shifts[left], shifts[right] = -half, half
            contours[box] += _merged(contours[left], contours[right], half)
    x = [-min(start for start, _ in contours[0])] * len(children)
    for box, below in enumerate(children):
        for child in below:
            x[child] = x[box] + shifts[child]
    return x


def _merged(
    left: list[tuple[float, float]], right: list[tuple[float, float]], half: float
) -> list[tuple[float, float]]:
    """Return the contour of two subtrees whose roots are `half` to either side."""
    n_common = min(len(left), len(right))
    both = [(left[depth][0] - half, right[depth][1] + half) for depth in range(n_common)]
    deeper, shift = (left, -half) if len(left) > len(right) else (right, half)
    return both + [(start + shift, end + shift) for start, end in deeper[n_common:]]
