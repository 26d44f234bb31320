"""Random networks and states, among them states that lie exactly on the boundaries of tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

import otr
from otr.core.head import Head

HEADS = ("identity", "tanh_box", "clip_box", "sign", "argmax")  # exp is asked for by name: it overflows

# Orfanos 2023, Fig. 3.1.
WORKED_WEIGHTS = ([[-2.7, -0.8], [0.2, 2.0], [1.0, -0.1]], [[-2.0, -2.4, 1.2]])
WORKED_BIASES = ([-0.4, 0.6, 1.2], [1.4])


def worked_network() -> otr.ReluNetwork:
    return otr.ReluNetwork(WORKED_WEIGHTS, WORKED_BIASES)


@dataclass(frozen=True)
class Case:
    """A network and states. If exact, all numbers are small dyadic ones, so no sum is ever rounded."""

    network: otr.ReluNetwork
    states: NDArray[np.float64]
    exact: bool


def make_head(name: str, n_outputs: int, rng: np.random.Generator) -> Head:
    low = -rng.integers(1, 4, n_outputs) / 2
    high = rng.integers(1, 4, n_outputs) / 2
    heads: dict[str, Head] = {
        "identity": otr.Identity(),
        "exp": otr.Exp(),
        "tanh_box": otr.TanhBox(low, high),
        "clip_box": otr.ClipBox(low, high),
        "sign": otr.Sign(),
        "argmax": otr.Argmax(),
    }
    return heads[name]


def make_network(
    rng: np.random.Generator,
    widths: tuple[int, ...],
    *,
    n_inputs: int = 3,
    n_outputs: int = 1,
    dense: bool | str = False,
    negative_slope: float = 0.0,
    head: str = "identity",
    exact: bool = False,
) -> otr.ReluNetwork:
    weights, biases, made = [], [], []
    for width in (*widths, n_outputs):
        earlier = sum(made) if dense in ("all", True) else sum(made[-1:])
        columns = earlier + (n_inputs if not made or dense else 0)
        if exact:
            weights.append(rng.integers(-2, 3, (width, columns)).astype(float))
            biases.append(rng.integers(-2, 3, width).astype(float))
        else:
            weights.append(rng.normal(size=(width, columns)))
            biases.append(rng.normal(size=width) / 2)
        made.append(width)
    return otr.ReluNetwork(
        weights, biases, dense=dense, negative_slope=negative_slope, head=make_head(head, n_outputs, rng)
    )


def boundary_states(network: otr.ReluNetwork, X: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return each state moved onto the hyperplane of one test on its own path, as nearly as rounding allows."""
    tree = otr.map_network(network)
    if tree.n_nodes == 0:
        return X
    moved = X.copy()
    for row, nodes in enumerate(np.split(*_csr_rows(tree, X))):
        node = rng.choice(nodes)
        P, v = tree.P[node], tree.v[node]
        if P @ P > 1e-6:
            moved[row] -= (P @ X[row] + v) / (P @ P) * P
    return moved


def _csr_rows(tree: otr.ObliqueTree, X: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    paths = tree.decision_path(X)
    return paths.indices, paths.indptr[1:-1]


@st.composite
def cases(draw: st.DrawFn, *, heads: tuple[str, ...] = HEADS, max_layers: int = 4) -> Case:
    widths = tuple(draw(st.lists(st.integers(1, 3), max_size=max_layers)))
    head = draw(st.sampled_from(heads))
    n_outputs = 1 if head == "sign" else draw(st.integers(1, 4))
    n_inputs = draw(st.integers(1, 4))
    exact = draw(st.booleans())
    slope = draw(st.sampled_from((0.0, 0.5) if exact else (0.0, 0.01, 0.5)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    network = make_network(
        rng,
        widths,
        n_inputs=n_inputs,
        n_outputs=n_outputs,
        dense=draw(st.sampled_from((False, "input", "all"))),
        negative_slope=slope,
        head=head,
        exact=exact,
    )
    if exact:
        return Case(network, rng.integers(-2, 3, (60, n_inputs)).astype(float), True)
    states = rng.normal(size=(40, n_inputs)) * 2
    return Case(network, np.concatenate((states, boundary_states(network, states[:20], rng))), False)


def assert_same_answers(answers: NDArray, expected: NDArray, network: otr.ReluNetwork, case: Case) -> None:
    """Values agree to 1e-9; labels agree where no tie is within rounding, and everywhere in an exact case."""
    if answers.dtype.kind == "i" and not case.exact:
        outputs = network.forward(case.states)
        if isinstance(network.head, otr.Sign):
            clear = np.abs(outputs[:, 0]) > 1e-9
        else:
            ranked = np.sort(outputs, axis=1)
            clear = ranked[:, -1] - ranked[:, -2] > 1e-9 if outputs.shape[1] > 1 else np.ones(len(outputs), bool)
        answers, expected = answers[clear], expected[clear]
    np.testing.assert_allclose(answers, expected, rtol=1e-9, atol=1e-9)
