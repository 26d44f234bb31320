"""The regions between hyperplanes in few dimensions, by their vertices: without a linear program.

Where the normals span the space, every region has a vertex. Where the hyperplanes are in general position, a vertex
lies on as many of them as there are dimensions, and the regions around it have either side of those, in every
combination, and its own side of all others. So the distinct signs around all vertices are the regions. Whether that is
so is checked, well beyond rounding; where it is not, or where there is too much to do, the answer is None, and
`otr.geometry.arrangement` walks.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from otr.core.arrays import BoolArray, FloatArray, IntArray, pack_rows
from otr.geometry.largest_balls import rounding_at
from otr.geometry.simplex import LARGEST_RADIUS

_MAX_SIGNS = 2**25  # around all vertices: half a second
_MAX_NUMBERS = 2**23  # of all regions
_MAX_SHARE = 16  # signs around all vertices for a region: beyond, the walk is as fast
_MAX_ROWS = 64  # whose signs fit into a word
_SMALLEST_VOLUME = 1e-9  # spanned by unit normals: below, they may be dependent
_APART = 1e-9  # a vertex from all other hyperplanes, at least
_ROUNDING = 1e-14


def regions_at_vertices(
    a: FloatArray, b: FloatArray, side_of: IntArray, max_regions: int
) -> tuple[BoolArray, FloatArray] | None:
    """Return the signs (k, m) and inner points (k, d) of all regions between hyperplanes, or None: use another method.

    The hyperplanes ``a . x + b = 0`` have normals a (m, d) of unit length. `side_of` (m,) is the input whose limit a
    hyperplane is, so that only its positive side counts; -1 for others. None also where there will be more than
    `max_regions`.
    """
    m, d = a.shape
    r, is_side = min(m, d), side_of >= 0
    n_regions, n_around = sum(comb(m, i) for i in range(r + 1)), comb(m, r) * 2**r  # more than there are, in a box
    if not r or m > _MAX_ROWS or (n_regions > max_regions and not is_side.any()):
        return None
    if n_around > _MAX_SHARE * n_regions or n_around * m > _MAX_SIGNS or n_regions * m > _MAX_NUMBERS:
        return None
    basis = np.eye(d) if m >= d else np.linalg.qr(a.T)[0].T  # of the space that the normals span
    a = a @ basis.T

    on = _meeting(r, side_of)
    if not len(on) or (np.abs(np.linalg.det(a[on])) < _SMALLEST_VOLUME).any():
        return None
    inverse = np.linalg.inv(a[on])
    vertices = np.matmul(inverse, -b[on][:, :, None])[:, :, 0]
    values = vertices @ a.T + b
    np.put_along_axis(values, on, np.inf, axis=1)
    margins = np.abs(values).min(axis=1)
    size = 1 + np.abs(b).max() + np.abs(vertices).max(axis=1)
    if (margins <= np.maximum(_APART, _ROUNDING * r * np.abs(inverse).max(axis=(1, 2)) * size)).any():
        return None

    inside = np.flatnonzero((values[:, is_side] > 0).all(axis=1))  # around others, all is outside
    clearest = inside[np.argsort(-margins[inside], kind="stable")]
    signs, vertex, turn = _signs_around(values[clearest] > 0, on[clearest], is_side)
    if len(signs) != n_regions and not is_side.any():
        return None
    vertex = clearest[vertex]

    # From the vertex into the region, away from all of its r hyperplanes at the same pace.
    directions = np.matmul(inverse, 2.0 * _turns(r).T - 1.0)[vertex, :, turn]
    with np.errstate(divide="ignore"):
        lengths = np.abs(values[vertex] / (directions @ a.T)).min(axis=1) / 2
    centres = vertices[vertex] + np.minimum(lengths, LARGEST_RADIUS)[:, None] * directions
    values = centres @ a.T + b
    radii = np.where(signs, values, -values).min(axis=1)
    if (radii <= rounding_at(centres)).any():
        return None
    return signs, centres @ basis


def _meeting(r: int, side_of: IntArray) -> IntArray:
    """Return the hyperplanes on every vertex: (n_vertices, r). The two limits of an input do not meet."""
    subsets = np.array(list(combinations(range(len(side_of)), r)))
    if (side_of < 0).all():
        return subsets
    inputs = np.sort(np.where(side_of >= 0, side_of, -1 - np.arange(len(side_of)))[subsets], axis=1)
    meet: IntArray = subsets[(inputs[:, 1:] != inputs[:, :-1]).all(axis=1)]
    return meet


def _turns(r: int) -> BoolArray:
    """Return every combination of sides of r hyperplanes: (2**r, r)."""
    turns: BoolArray = (np.arange(2**r)[:, None] >> np.arange(r) & 1).astype(np.bool_)
    return turns


def _signs_around(positive: BoolArray, on: IntArray, is_side: BoolArray) -> tuple[BoolArray, IntArray, IntArray]:
    """Return the distinct signs (k, m) around vertices, the first vertex (k,) of each and which of `_turns` (k,) it is.

    All hyperplanes have the signs `positive` (n, m) at the vertices, which lie on the hyperplanes `on` (n, r); of those
    with `is_side` (m,) only the positive side counts.
    """
    (n, m), r = positive.shape, on.shape[1]
    signs = np.repeat(positive[:, None], 2**r, axis=1)
    np.put_along_axis(signs, on[:, None].repeat(2**r, axis=1), _turns(r)[None].repeat(n, axis=0), axis=2)
    signs = signs.reshape(-1, m)
    counting = np.flatnonzero(signs[:, is_side].all(axis=1))
    first = counting[np.unique(pack_rows(signs[counting])[:, 0], return_index=True)[1]]
    return signs[first], first // 2**r, first % 2**r
