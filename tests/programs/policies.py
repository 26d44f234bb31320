"""The trees that every format is tried on, and states for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import otr
from otr.control import pid_network
from tests.committed import committed_tree
from tests.core.strategies import make_network, worked_network

COMMITTED = {
    "hopper": "hopper/otr/depth-6/quick/seed-0",
    "lander": "lunarlander/otr/depth-2/thesis/seed-0",
    "viper": "lunarlander/viper/depth-6/quick/seed-0",
    "swimmer": "swimmer/sdt/depth-6/quick/seed-0",
    "pid": "pendulum/pid/depth-1/quick/seed-0",
}


def committed(name: str) -> otr.ObliqueTree:
    """Return the tree of a committed run."""
    return committed_tree(COMMITTED[name])


def chain(n_nodes: int, head: otr.Head | None = None) -> otr.ObliqueTree:
    """Return stairs: leaf k answers (k, -k) for k < x0 + k x1 / 4 <= k + 1; as deep as it has tests."""
    steps = np.arange(n_nodes)
    left, right = ~steps, np.append(steps[1:], ~n_nodes)
    P = np.column_stack((np.ones(n_nodes), steps / 4))
    leaves = np.arange(n_nodes + 1.0)
    return otr.ObliqueTree(
        left, right, P, -steps.astype(float), np.zeros((n_nodes + 1, 2, 2)), np.column_stack((leaves, -leaves)),
        head=head,
    )  # fmt: skip


def without_labels(tree: otr.ObliqueTree, head: otr.Head) -> otr.ObliqueTree:
    """Return a tree whose head decides on the outputs, below no tests of its own."""
    return otr.ObliqueTree(tree.children_left, tree.children_right, tree.P, tree.v, tree.M, tree.c, head=head)


def policies() -> dict[str, otr.ObliqueTree]:
    """Return small trees of every kind by name."""
    rng = np.random.default_rng(0)
    made = {"worked": otr.map_network(worked_network())}
    for head, n_outputs in (("identity", 2), ("exp", 2), ("tanh_box", 2), ("clip_box", 3), ("sign", 1), ("argmax", 3)):
        name = "count" if head == "exp" else head  # exp is a function of C
        made[name] = otr.map_network(make_network(rng, (2, 2), n_inputs=3, n_outputs=n_outputs, head=head))
        made[f"{name}_of_one_leaf"] = otr.map_network(make_network(rng, (), n_outputs=n_outputs, head=head))
    plain = otr.map_network(make_network(rng, (3,), n_outputs=3))
    made["argmax_without_labels"] = without_labels(plain, otr.Argmax())
    made["sign_without_labels"] = without_labels(otr.map_network(make_network(rng, (3,))), otr.Sign())
    made["wide_tanh"] = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], [[[900.0]], [[-900.0]]], [[0.0], [1.0]],
                                        head=otr.TanhBox(0.0, 4.0))  # fmt: skip
    made["same_tanh"] = otr.map_network(
        otr.ReluNetwork(
            [rng.normal(size=(3, 2)), rng.normal(size=(2, 3))],
            [rng.normal(size=3), rng.normal(size=2)],
            head=otr.TanhBox(-np.ones(2), np.ones(2)),
        )
    )
    made["labels"] = otr.ObliqueTree([1, ~0], [~2, ~1], [[0.0, 1.0], [-3.0, 0.0]], [0.5, 1.0], np.zeros((3, 1, 2)),
                                     np.zeros((3, 1)), labels=[-7, 40_000, 3_000_000_000])  # fmt: skip
    made["one_label"] = otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[1.0]]], [[0.0]], labels=[5])
    made["dense_links"] = otr.map_network(make_network(rng, (2, 2), dense="all", negative_slope=0.25))
    sparse = np.where(rng.random((3, 12)) < 0.2, rng.normal(size=(3, 12)), 0.0)
    made["sparse"] = otr.ObliqueTree([1, 2, ~0], [~3, ~2, ~1], sparse, [0.1, -0.1, 0.0], np.zeros((4, 1, 12)),
                                     [[1.5], [2.5], [1e-300], [-1e-5]])  # fmt: skip
    made["mixed"] = otr.ObliqueTree([~0], [~1], [[0.0, 0.0, 0.0]], [0.0],
                                    [[[0.0, 0.0, 2.0]], [[1.0, 0.0, 0.0]]], [[0.25], [1e20]])  # fmt: skip
    made["exact"] = otr.map_network(make_network(rng, (2, 2), n_outputs=2, exact=True))
    for name, layers, n_inputs, low, high in (
        ("pid", (2,), 2, [-2.0], [2.0]),
        ("pid_of_two_actions", (2, 1), 1, [-1.0, 0.0], [1.0, 4.0]),
        ("pid_of_one_leaf", (), 2, [-1.0], [1.0]),
    ):
        gains = make_network(rng, layers, n_inputs=n_inputs, n_outputs=3 * n_inputs * len(low))
        made[name] = otr.map_network(pid_network(gains, low, high))
    made["stairs"] = chain(20, otr.ClipBox([-5.0, -8.0], [9.0, -1.0]))
    return made


def states_for(tree: otr.ObliqueTree, n: int = 1000) -> NDArray[np.float64]:
    """Return Gaussian states, and whole numbers, with which sums of a tree of small dyadic numbers are exact."""
    rng = np.random.default_rng(1)
    whole = rng.integers(-3, 9, (n // 4, tree.n_inputs)).astype(float)
    return np.concatenate((rng.normal(size=(n - len(whole), tree.n_inputs)) * 2, whole))


def assert_answers(tree: otr.ObliqueTree, states: NDArray[np.float64], answers: Sequence[object]) -> None:
    """Check what a program answered: values to 1e-9, labels one by one."""
    expected = tree.predict(states)
    if expected.dtype.kind == "i":
        np.testing.assert_array_equal(answers, expected)
    else:
        np.testing.assert_allclose(np.asarray(answers, dtype=np.float64), expected, rtol=1e-9, atol=1e-9)
