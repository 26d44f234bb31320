"""Trees that are a little shorter than a given one: what `otr.simplify` tries."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from otr.core.arrays import FloatArray, IntArray
from otr.core.heads import Identity
from otr.core.pruning import keep_leaves
from otr.core.tree import ObliqueTree
from otr.geometry.regions import leaf_paths
from otr.shorten.refit_tests import refit_tests

_AGREEMENTS = (0.8, 0.9, 0.95)  # with the original test, of one that is refitted; the loosest is tried first
_NEAR_LIMIT = 0.1  # of an action's range: a constant this close to its limit is tried as the limit


def n_numbers(tree: ObliqueTree) -> int:
    """Return how long a tree's program is: numbers in it that are not 0, labels, and tests."""
    of_leaves = tree.n_leaves if tree.labels is not None else np.count_nonzero(tree.M) + np.count_nonzero(tree.c)
    return int(np.count_nonzero(tree.P) + np.count_nonzero(tree.v) + of_leaves) + tree.n_nodes


def without_a_test(tree: ObliqueTree) -> Iterator[ObliqueTree]:
    """Yield trees without one of the tests and the subtree on one of its sides, those that save most first."""
    nodes, signs = leaf_paths(tree)
    cuts = []
    for node in range(tree.n_nodes):
        for sign in (-1, 1):
            below = ((nodes == node) & (signs == sign)).any(axis=1)
            cuts.append((int(below.sum()), node, sign, below))
    for _, _, _, below in sorted(cuts, key=lambda cut: (-cut[0], cut[1], cut[2])):
        yield keep_leaves(tree, ~below)


def clipped(tree: ObliqueTree) -> Iterator[ObliqueTree]:
    """Yield the tree with clipped outputs in the place of tanh, of the same slope at 0."""
    tangent = tree.head.tangent(tree.n_outputs)
    if tangent is not None:
        slopes, values = tangent
        yield tree.replace(M=tree.M * slopes[:, None], c=tree.c * slopes + values, head=tree.head.clip())


def constant_leaves(tree: ObliqueTree, X: FloatArray) -> Iterator[ObliqueTree]:
    """Yield trees in which a leaf's output is one number: its mean action on the states X, or the limit nearby."""
    if tree.labels is not None or not tree.head.is_projection:
        return
    leaves, actions = tree.apply(X), tree.predict(X)
    visits = np.bincount(leaves, minlength=tree.n_leaves)
    for leaf in np.argsort(visits, kind="stable").tolist():
        for output in np.flatnonzero(tree.M[leaf].any(axis=1)).tolist():
            if not visits[leaf]:
                continue
            mean = float(actions[leaves == leaf, output].mean())
            for value in dict.fromkeys((_nearest_limit(tree, output, mean), mean)):
                M, c = tree.M.copy(), tree.c.copy()
                M[leaf, output], c[leaf, output] = 0.0, value
                yield tree.replace(M=M, c=c)


def _nearest_limit(tree: ObliqueTree, output: int, value: float) -> float:
    """Return the limit of an action that a value is near to, or the value."""
    limits = tree.head.limits(tree.n_outputs)
    if limits is None:
        return value
    low, high = (float(limit[output]) for limit in limits)
    near = _NEAR_LIMIT * (high - low)
    return low if value - low <= near else high if high - value <= near else value


def refitted(tree: ObliqueTree, node: int, X: FloatArray) -> Iterator[ObliqueTree]:
    """Yield trees in which a test is refitted on the states X by sparse linear discriminant analysis."""
    for agreement in _AGREEMENTS:
        refit = refit_tests(tree, X, agreement=agreement, digits=3, nodes=[node])
        if refit.tests[node].change == "refitted":
            P, v = tree.P.copy(), tree.v.copy()
            P[node], v[node] = refit.tree.P[node], refit.tree.v[node]
            yield tree.replace(P=P, v=v)


def turned(tree: ObliqueTree, node: int) -> Iterator[ObliqueTree]:
    """Yield the tree with a test reversed, if it starts with a minus; a state on its boundary changes sides."""
    numbers = np.append(tree.P[node][tree.P[node] != 0], tree.v[node])
    if numbers[0] < 0:
        P, v, left, right = tree.P.copy(), tree.v.copy(), tree.children_left.copy(), tree.children_right.copy()
        P[node], v[node] = -P[node], -v[node]
        left[node], right[node] = right[node], left[node]
        yield tree.replace(P=P + 0.0, v=v + 0.0, children_left=left, children_right=right)


def with_unit_tests(tree: ObliqueTree) -> Iterator[ObliqueTree]:
    """Yield the tree with every test scaled so that its largest coefficient is 1 or -1, the same but for rounding."""
    size = np.abs(tree.P).max(axis=1, initial=0.0)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        can_be = (size > 0) & np.isfinite(tree.v / size)
    scale = np.where(can_be, size, 1.0)
    if (scale != 1.0).any():
        yield tree.replace(P=tree.P / scale[:, None], v=tree.v / scale)


def without_idle_head(tree: ObliqueTree) -> ObliqueTree:
    """Return the tree without a clip that never acts, because all outputs are constants within the limits."""
    if not tree.head.is_projection or tree.labels is not None or tree.M.any():
        return tree
    return tree.replace(c=np.asarray(tree.head(tree.c)), head=Identity())


def numbers_of(tree: ObliqueTree) -> FloatArray:
    """Return all numbers of tests and leaves in one row."""
    leaves = np.zeros(0) if tree.labels is not None else np.concatenate((tree.M.ravel(), tree.c.ravel()))
    return np.concatenate((tree.P.ravel(), tree.v, leaves))


def with_numbers(tree: ObliqueTree, which: IntArray, value: float) -> ObliqueTree:
    """Return the tree with one value in the place of some of `numbers_of`."""
    numbers = numbers_of(tree)
    numbers[which] = value
    return of_numbers(tree, numbers)


def of_numbers(tree: ObliqueTree, numbers: FloatArray) -> ObliqueTree:
    """Return the tree with other numbers, in the order of `numbers_of`."""
    ends = np.cumsum([tree.P.size, tree.v.size, tree.M.size])
    P, v = numbers[: ends[0]].reshape(tree.P.shape), numbers[ends[0] : ends[1]]
    if tree.labels is not None:
        return tree.replace(P=P, v=v)
    M, c = numbers[ends[1] : ends[2]].reshape(tree.M.shape), numbers[ends[2] :].reshape(tree.c.shape)
    return tree.replace(P=P, v=v, M=M, c=c)


def numbers_by_effect(tree: ObliqueTree, X: FloatArray) -> IntArray:
    """Return the numbers that are not 0, least effect on the states first: of a test, relative to its other terms."""
    size = np.sqrt(np.mean(X**2, axis=0))
    tests = np.column_stack((np.abs(tree.P) * size, np.abs(tree.v)))
    effects = tests / np.maximum(tests.max(axis=1, keepdims=True, initial=0.0), 1e-300)
    parts = [effects[:, :-1], effects[:, -1]]
    if tree.labels is None:
        terms = np.concatenate((np.abs(tree.M) * size, np.abs(tree.c)[..., None]), axis=2)
        visits = np.bincount(tree.apply(X), minlength=tree.n_leaves) / len(X)
        largest = np.maximum(terms.max(axis=2, keepdims=True, initial=0.0), 1e-300)
        of_leaves = terms / largest * np.sqrt(visits)[:, None, None]
        parts += [of_leaves[..., :-1], of_leaves[..., -1]]
    effect = np.concatenate([part.ravel() for part in parts])
    order = np.argsort(effect, kind="stable")
    return np.asarray(order[numbers_of(tree)[order] != 0.0])
