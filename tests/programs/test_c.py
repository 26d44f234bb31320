"""C: every policy is compiled with warnings as errors, loaded and run."""

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import otr
from otr.control import pid_network
from otr.core.network import ReluNetwork
from otr.core.smooth_network import ACTIVATIONS, SmoothNetwork
from pipelines.play.actor_files import load_actor
from tests.committed import RESULTS
from tests.core.strategies import make_network
from tests.programs.policies import COMMITTED, assert_answers, chain, committed, policies, states_for

COMPILER = shutil.which("gcc") or shutil.which("cc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler (gcc or cc) on the PATH")
FLAGS = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-Wmissing-prototypes", "-Wshadow"]
POLICIES = policies()
NUMBERS = {"double": (ctypes.c_double, np.float64), "float": (ctypes.c_float, np.float32)}
LABELS = {"int": ctypes.c_int, "long": ctypes.c_long, "long long": ctypes.c_longlong}


def compiled(sources: dict[str, str], folder: Path) -> ctypes.CDLL:
    """Compile sources together, under warnings as errors, and load them."""
    for name, source in sources.items():
        (folder / f"{name}.c").write_text(source)
    files = [str(folder / f"{name}.c") for name in sources]
    library = folder / "policies.so"
    command = [str(COMPILER), *FLAGS, "-O1", "-fPIC", "-shared", *files, "-lm", "-o", str(library)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(library))


def runner(library: ctypes.CDLL, name: str, source: str) -> Callable[[NDArray], NDArray]:
    """Return what answers states (n, d) by calling the function that a source declares."""
    (signature,) = re.findall(rf"^(\w.* {name}(?:_label)?\(.*\));", source, re.M)
    number, dtype = NUMBERS[re.search(r"const (\w+) x", signature)[1]]
    labelled = re.match(rf"(.*) {name}_label\(", signature)
    function = getattr(library, f"{name}_label" if labelled else name)
    function.restype = LABELS[labelled[1]] if labelled else None

    def run(states: NDArray) -> NDArray:
        X = np.ascontiguousarray(states, dtype=dtype)
        rows = [(number * X.shape[1]).from_buffer(row) for row in X]
        if labelled:
            return np.array([function(row) for row in rows])
        y = (number * int(re.search(r" y\[(\d+)\]", signature)[1]))()
        answers = []
        for row in rows:
            function(row, y)
            answers.append(list(y))
        return np.array(answers)

    return run


def test_every_policy(tmp_path: Path) -> None:
    sources = {name: otr.to_c(tree, name=name) for name, tree in POLICIES.items()}
    library = compiled(sources, tmp_path)
    for name, tree in POLICIES.items():
        states = states_for(tree)
        assert_answers(tree, states, runner(library, name, sources[name])(states))


def test_ten_thousand_states_of_committed_policies(tmp_path: Path) -> None:
    trees = {name: committed(name) for name in COMMITTED}
    sources = {name: otr.to_c(tree, name=name) for name, tree in trees.items()}
    library = compiled(sources, tmp_path)
    for name, tree in trees.items():
        states = states_for(tree, 10_000)
        assert_answers(tree, states, runner(library, name, sources[name])(states))


def test_float(tmp_path: Path) -> None:
    names = [name for name in POLICIES if name not in ("labels", "stairs", "mixed")]  # jumps, and 1e20
    sources = {name: otr.to_c(POLICIES[name], name=name, dtype="float") for name in names}
    library = compiled(sources, tmp_path)
    for name in names:
        tree = POLICIES[name]
        states = states_for(tree).astype(np.float32)
        answers = runner(library, name, sources[name])(states)
        if answers.dtype.kind == "i":
            away = _distance_to_tests(tree, states) > 1e-5
            assert away.mean() > 0.5
            np.testing.assert_array_equal(answers[away], tree.predict(states)[away])
        else:
            np.testing.assert_allclose(answers, tree.predict(states), rtol=1e-4, atol=1e-4)


def _distance_to_tests(tree: otr.ObliqueTree, states: NDArray) -> NDArray:
    """Return how far each state's tests, and what its head compares, are from a tie."""
    y = np.sort(tree.forward(states), axis=1)
    ties = np.abs(y[:, -1] - y[:, -2]) if y.shape[1] > 1 else np.abs(y[:, 0])
    tests = np.abs(states @ tree.P.T + tree.v) if tree.n_nodes else np.ones((len(states), 1))
    return np.minimum(tests.min(axis=1), ties)


def networks() -> dict[str, ReluNetwork]:
    rng = np.random.default_rng(3)
    return {
        "no_layer": make_network(rng, (), n_outputs=2, head="clip_box"),
        "one_layer": make_network(rng, (5,), n_outputs=2, head="tanh_box"),
        "leaky": make_network(rng, (5,), n_outputs=2, negative_slope=0.25),
        "binary": make_network(rng, (4,), head="sign"),
        "chosen": make_network(rng, (4,), n_outputs=3, head="argmax"),
        "two_layers": make_network(rng, (4, 3), n_outputs=2, head="clip_box"),
        "three_leaky": make_network(rng, (2, 3, 2), n_outputs=2, negative_slope=0.01, head="argmax"),
        "dense_input": make_network(rng, (4, 3), n_outputs=2, dense="input"),
        "dense_all": make_network(rng, (4, 3, 2), n_outputs=2, dense="all"),
        "dense_one": make_network(rng, (4,), n_outputs=2, dense="all"),
        "gains": pid_network(make_network(rng, (4,), n_inputs=2, n_outputs=12), [-1.0, -2.0], [1.0, 2.0]),
        "constant_gains": pid_network(make_network(rng, (), n_inputs=2, n_outputs=6), [-1.0], [1.0]),
        "exact_net": make_network(rng, (4, 3), n_outputs=3, exact=True, head="argmax"),
    }


@pytest.mark.parametrize("dtype", ["double", "float"])
def test_networks_in_the_compact_form(dtype: str, tmp_path: Path) -> None:
    sources = {name: otr.to_c(net, name=name, dtype=dtype) for name, net in networks().items()}
    library = compiled(sources, tmp_path)
    tolerance = 1e-9 if dtype == "double" else 1e-4
    for name, network in networks().items():
        states = np.random.default_rng(0).normal(size=(500, network.n_inputs))
        if name == "exact_net":
            states = np.round(states * 2)
        answers = runner(library, name, sources[name])(states)
        expected = network.predict(states.astype(dtype if dtype == "double" else np.float32).astype(float))
        agree = np.isclose(answers, expected, rtol=tolerance, atol=tolerance)
        assert agree.all(), (name, answers[~agree], expected[~agree])


@pytest.mark.parametrize("dtype", ["double", "float"])
def test_networks_of_every_activation(dtype: str, tmp_path: Path) -> None:
    rng, states = np.random.default_rng(4), np.random.default_rng(0).normal(scale=4, size=(10_000, 6))
    nets, tolerance = {}, 1e-9 if dtype == "double" else 1e-4
    for activation in ACTIVATIONS:
        layers = make_network(rng, (64, 64), n_inputs=6, n_outputs=2)
        weights = [W / np.sqrt(W.shape[1]) for W in layers.weights]
        head = otr.TanhBox(-2.0, 2.0) if activation == "elu" else otr.ClipBox(-3.0, 3.0)
        nets[activation] = SmoothNetwork(weights, layers.biases, activation=activation, head=head)
    nets["chosen"] = nets["tanh"].replace(head=otr.Argmax())
    nets["linear"] = SmoothNetwork([np.ones((1, 6))], [[1.0]], activation="tanh")
    sources = {name: otr.to_c(net, name=f"{name}_of", dtype=dtype) for name, net in nets.items()}
    library = compiled(sources, tmp_path)
    for name, net in nets.items():
        answers = runner(library, f"{name}_of", sources[name])(states)
        expected = net.predict(states.astype(NUMBERS[dtype][1]).astype(float))
        agree = np.isclose(answers, expected, rtol=tolerance, atol=tolerance)
        assert agree.mean() > 0.999 if name == "chosen" else agree.all(), name  # labels: but for ties
    assert "(-lm) for tanh" in sources["tanh"] and "exp, fabs, log1p, tanh" in sources["mish"]


def test_the_compact_form_is_the_full_tree_in_fewer_bytes() -> None:
    run = RESULTS / "runs/hopper/otr/depth-6/quick/seed-0"
    network = load_actor(run / "train")
    full, compact = otr.map_network(network), network
    # One row of 11 weights, a bias and 3 contributions a neuron, and 3 biases; against maps for 64 leaves.
    assert table_bytes(otr.to_c(compact)) == 8 * (6 * 15 + 3)
    assert table_bytes(otr.to_c(compact, dtype="float")) == 4 * (6 * 15 + 3)
    # 6 distinct tests of 63, and a map for each of 64 leaves, then a byte for each index.
    assert table_bytes(otr.to_c(full)) == 8 * 12 * (6 + 3 * 64) + 63 * (2 + 1)


def table_bytes(source: str) -> int:
    """Return what the comment says the tables take, compared with the tables themselves."""
    sizes = {"double": 8, "float": 4} | {f"{u}int{bits}_t": bits // 8 for u in ("", "u") for bits in (8, 16, 32, 64)}
    found = 0
    for kind, shape in re.findall(r"^static const (\w+) \w+((?:\[\d+\])+) = ", source, re.M):
        found += sizes[kind] * int(np.prod([int(n) for n in re.findall(r"\d+", shape)]))
    told = int(re.search(r"([\d,]+) bytes of constant tables", source)[1].replace(",", ""))
    assert told == found
    return told


def test_rows_are_stored_in_the_least_bytes() -> None:
    rng = np.random.default_rng(0)

    def tests_of(P: NDArray) -> str:
        n = len(P)
        children = [*range(1, n), ~0], [~i for i in range(n, 0, -1)]
        answers = np.arange(n + 1.0)[:, None] % 2  # no two leaves side by side answer the same, which would merge them
        tree = otr.ObliqueTree(*children, P, rng.normal(size=n), np.zeros((n + 1, 1, P.shape[1])), answers)
        return otr.to_c(tree)

    dense = rng.normal(size=(20, 30))
    assert "double policy_tests[20][31]" in tests_of(dense)
    sparse = np.where(rng.random((20, 30)) < 0.1, dense, 0.0)
    assert "uint8_t policy_tests_columns[" in tests_of(sparse)
    single = np.eye(30)[rng.integers(0, 30, 20)]
    assert "uint8_t policy_tests_column[20]" in tests_of(single)
    for P in (dense, sparse, single):
        assert table_bytes(tests_of(P)) <= table_bytes(tests_of(dense))
        assert "policy_rows[2]" in tests_of(P), "two constants for all leaves"


@pytest.mark.parametrize(("n_nodes", "kind"), [(127, "int8_t"), (128, "int16_t")])
def test_indices_have_the_smallest_type_that_fits(n_nodes: int, kind: str) -> None:
    assert f"static const {kind} policy_children" in otr.to_c(chain(n_nodes))


def test_a_deep_tree(tmp_path: Path) -> None:
    tree = chain(33_000)
    source = otr.to_c(tree, name="deep")
    assert "static const int32_t deep_children" in source
    states = np.array([[32_999.5, 0.0], [33_000.5, 0.0], [0.0, 0.0], [7.0, 1.0]])
    assert_answers(tree, states, runner(compiled({"deep": source}, tmp_path), "deep", source)(states))


def test_a_pattern_tree_is_its_network_or_its_paths() -> None:
    network = networks()["one_layer"]
    assert otr.to_c(otr.PatternTree(network)) == otr.to_c(network)
    paths = otr.PatternTree(network).observe(states_for(otr.map_network(network))).keep(3)
    assert otr.to_c(paths) == otr.to_c(paths.to_tree())


def tiny_test() -> otr.ObliqueTree:
    """Return a tree that tells x > 0 by a number that single precision does not hold."""
    return otr.ObliqueTree([-1], [-2], [[1e-50]], [0.0], np.zeros((2, 1, 1)), [[-1.0], [1.0]])


def test_other_arguments_are_checked() -> None:
    with pytest.raises(ValueError, match="dtype is 'half', expected 'double' or 'float'"):
        otr.to_c(POLICIES["worked"], dtype="half")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="policy is a str"):
        otr.to_c("worked")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="1e\\+300, too large for a float"):
        otr.to_c(otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[1e300]]], [[0.0]]), dtype="float")
    with pytest.raises(ValueError, match="feature_names has 1 names, expected 2"):
        otr.to_c(POLICIES["worked"], feature_names=["x"])
    with pytest.raises(ValueError, match="largest weight is 1e-50, too small for a float"):
        otr.to_c(tiny_test(), dtype="float")
    with pytest.raises(ValueError, match="largest weight is 1e-50, too small for a float"):
        otr.to_c(otr.ReluNetwork([[[1e-50]], [[1.0]]], [[0.0], [0.0]], head=otr.Sign()), dtype="float")
    assert otr.to_c(tiny_test())
