"""float_error: compiled code in both precisions is held to the bound, in exact arithmetic."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import otr
from otr.geometry.rational import ExactTree, as_point
from tests.core.strategies import make_network
from tests.programs.policies import chain, committed
from tests.programs.test_c import COMPILER, NUMBERS, compiled, runner

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler (gcc or cc) on the PATH")


def trees() -> dict[str, otr.ObliqueTree]:
    rng = np.random.default_rng(0)
    one, deep = (make_network(rng, layers, n_inputs=4, n_outputs=2) for layers in ((6,), (3, 3)))
    box = (-2 * np.ones(4), 2 * np.ones(4))
    sparse = np.where(rng.random((7, 9)) < 0.3, rng.normal(size=(7, 9)), 0.0)
    sparse_leaves = np.where(rng.random((8, 1, 9)) < 0.2, rng.normal(size=(8, 1, 9)), 0.0)
    return {
        "one_layer": otr.map_network(one),
        "minimal": otr.minimal_tree(one, box),
        "two_layers": otr.map_network(deep),
        "clipped": otr.map_network(one.replace(head=otr.ClipBox(-0.7, 0.9))),
        "squashed": otr.map_network(deep.replace(head=otr.TanhBox(-0.1, 2.3))),
        "counts": otr.map_network(deep.replace(weights=[0.3 * W for W in deep.weights], head=otr.Exp())),
        "dense": otr.map_network(make_network(rng, (4,), n_inputs=4, dense="input", negative_slope=0.1)),
        "sparse": otr.ObliqueTree(
            [1, 2, 3, 4, 5, 6, ~0], [~7, ~6, ~5, ~4, ~3, ~2, ~1], sparse, np.zeros(7), sparse_leaves, np.zeros((8, 1))
        ),
        "stairs": chain(6),
        "hopper": committed("hopper"),
    }


def box_of(tree: otr.ObliqueTree) -> tuple[NDArray, NDArray]:
    return -2 * np.ones(tree.n_inputs), 2 * np.ones(tree.n_inputs)


def states_near_tests(tree: otr.ObliqueTree, n: int, dtype: type) -> NDArray:
    """Return states of the box that are numbers of a type: random ones, and such moved to a test or two."""
    rng = np.random.default_rng(0)
    X = rng.uniform(-2, 2, size=(n, tree.n_inputs))
    normals = (tree.P**2).sum(axis=1)
    for _ in range(3):
        nodes = rng.integers(tree.n_nodes, size=n // 2)
        P = tree.P[nodes]
        X[: n // 2] -= (np.einsum("nd,nd->n", X[: n // 2], P) + tree.v[nodes])[:, None] * P / normals[nodes, None]
    X += rng.choice([0.0, 1e-8, 1e-7], size=(n, 1)) * rng.normal(size=X.shape)
    X = X.astype(dtype).astype(np.float64)
    return X[(np.abs(X) <= 2).all(axis=1)]


def exact_answers(tree: otr.ObliqueTree, X: NDArray) -> NDArray:
    """Return the outputs before the head in rational arithmetic, (n, o) of Fraction."""
    exact = ExactTree(tree)
    points = [as_point(x) for x in X]
    return np.array([exact.outputs(exact.leaf(point), point) for point in points], dtype=object)


def computed(tree: otr.ObliqueTree, X: NDArray, dtype: str, folder: Path) -> NDArray:
    source = otr.to_c(tree, name="of", dtype=dtype)
    return runner(compiled({"of": source}, folder), "of", source)(X)


@pytest.mark.parametrize("dtype", ["float", "double"])
@pytest.mark.parametrize("name", trees())
def test_no_state_exceeds_the_bound(name: str, dtype: str, tmp_path: Path) -> None:
    tree = trees()[name]
    found = otr.float_error(tree, box_of(tree), dtype)
    X = states_near_tests(tree, 4000, NUMBERS[dtype][1])
    if found.n_jumps:
        distances = np.abs(X @ tree.P.T + tree.v) / np.sqrt((tree.P**2).sum(axis=1))
        X = X[(distances > found.distance).all(axis=1)]
    assert len(X) > 1000
    assert found.n_jumps == {"sparse": found.n_jumps, "stairs": 5, "hopper": 1}.get(name, 0)
    answers, outputs = computed(tree, X, dtype, tmp_path), exact_answers(tree, X)
    if isinstance(tree.head, otr.TanhBox | otr.Exp):
        expected = tree.head(outputs.astype(np.float64))
        worst = np.abs(answers - expected).max(axis=0) - 1e-14
    else:
        low, high = tree.head.limits(tree.n_outputs) or (None, None)
        expected = outputs if low is None else np.minimum(np.maximum(outputs, low), high)
        apart = [[abs(Fraction(a) - b) for a, b in zip(*each, strict=True)]
                 for each in zip(answers.tolist(), expected, strict=True)]  # fmt: skip
        worst = np.array(apart, dtype=np.float64).max(axis=0)
    assert (worst <= found.errors).all(), (worst, found.errors)
    assert found.max_error == found.errors.max()


def test_the_bound_is_near_what_is_seen(tmp_path: Path) -> None:
    net = otr.ReluNetwork([[[1.0, 0.3], [-0.7, 1.1]], [[1.3, 0.9]]], [[0.1, 0.2], [0.3]])
    tree = otr.map_network(net)
    found = otr.float_error(tree, box_of(tree))
    X = states_near_tests(tree, 20_000, np.float32)
    apart = np.abs(computed(tree, X, "float", tmp_path) - exact_answers(tree, X).astype(float)).max()
    assert apart <= found.max_error <= 10 * apart


def test_a_jump_is_excepted_up_to_its_distance(tmp_path: Path) -> None:
    tree = otr.parse_program("if 0.1 a + 0.3 b <= 0.7: a else: 5 + b", ["a", "b"])
    found = otr.float_error(tree, box_of(tree))
    X = states_near_tests(tree, 20_000, np.float32)
    apart = np.abs(computed(tree, X, "float", tmp_path) - exact_answers(tree, X).astype(float)).max(axis=1)
    distances = np.abs(X @ tree.P[0] + tree.v[0]) / np.hypot(*tree.P[0])
    assert found.n_jumps == 1 and (apart > 1).any()
    assert (distances[apart > found.max_error] <= found.distance).all()
    assert "farther than" in str(found) and "1 test at which the tree jumps" in str(found)


def test_labels(tmp_path: Path) -> None:
    decided = otr.map_network(make_network(np.random.default_rng(3), (4,), n_inputs=3, n_outputs=3, head="argmax"))
    undecided = decided.replace(labels=None)
    X = states_near_tests(decided, 20_000, np.float32)
    for tree in (decided, undecided):
        found = otr.float_error(tree, box_of(tree))
        source = otr.to_c(tree, name="of", dtype="float")
        labels = runner(compiled({"of": source}, tmp_path), "of", source)(X)
        other = labels != tree.predict(X)
        assert found.max_error == 0 and not len(found.errors)
        if tree is decided:
            distances = (np.abs(X @ tree.P.T + tree.v) / np.sqrt((tree.P**2).sum(axis=1))).min(axis=1)
            assert (distances[other] <= found.distance).all()
        else:
            lead = np.diff(np.sort(tree.forward(X), axis=1)[:, -2:], axis=1)[:, 0]
            assert (lead[other] <= found.margin).all() and found.margin < 1e-4


def test_the_comment_says_the_bound() -> None:
    tree = trees()["one_layer"]
    found = otr.float_error(tree, box_of(tree), "float")
    source = " ".join(otr.to_c(tree, dtype="float", error=found).replace(" * ", " ").split())
    assert f"For x in [-2, 2], [-2, 2], [-2, 2], [-2, 2]: {found}." in source
    with pytest.raises(ValueError, match="error is of dtype 'float', the program of 'double'"):
        otr.to_c(tree, error=found)


def test_what_has_no_bound_is_refused() -> None:
    tree = trees()["one_layer"]
    with pytest.raises(ValueError, match="the box has open sides"):
        otr.float_error(tree, (np.full(4, -np.inf), np.ones(4)))
    with pytest.raises(ValueError, match="multiplies outputs"):
        otr.float_error(committed("pid"), box_of(committed("pid")))
    with pytest.raises(ValueError, match=r"a row may reach .*, too large for a float"):
        otr.float_error(otr.parse_program("1e30 x", ["x"]), ([-1e20], [1e20]))
    with pytest.raises(ValueError, match="dtype is 'half'"):
        otr.float_error(tree, box_of(tree), "half")  # type: ignore[arg-type]
