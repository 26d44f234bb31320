"""`ObliqueTree.replace` and `ReluNetwork.replace` keep everything that they are not asked to change."""

import inspect
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from tests.core.strategies import make_network

NAMES = {"feature_names", "output_names"}  # which go where they no longer fit: test_tree.py
TREE_FIELDS = tuple(name for name in inspect.signature(otr.ObliqueTree).parameters if name not in NAMES)
NETWORK_FIELDS = tuple(inspect.signature(otr.ReluNetwork).parameters)
SEEDS = st.integers(0, 2**32 - 1)


def some_tree(rng: np.random.Generator, with_basis: bool) -> otr.ObliqueTree:
    d, o = 5, 3
    basis = rng.normal(size=(2, d)) if with_basis else None
    held = d if basis is None else len(basis)
    arrays = ([~0, ~1], [1, ~2], rng.normal(size=(2, held)), rng.normal(size=2), rng.normal(size=(3, o, held)))
    head = otr.ClipBox(-rng.random(o), rng.random(o))
    return otr.ObliqueTree(*arrays, rng.normal(size=(3, o)), labels=rng.integers(0, o, 3), head=head, basis=basis)


def other_field(tree: otr.ObliqueTree, name: str, rng: np.random.Generator) -> Any:
    if name == "head":
        return otr.Argmax()
    if name == "basis":
        return None if tree.basis is None else rng.normal(size=(len(tree.basis), 4))
    if name.startswith("children"):
        return {"children_left": [1, ~1], "children_right": [~0, ~2]}[name]
    if name == "labels":
        return (tree.labels + 1) % 3
    return getattr(tree, name) + 1


@given(SEEDS, st.booleans(), st.sets(st.sampled_from(TREE_FIELDS)))
def test_a_tree_keeps_its_other_fields(seed: int, with_basis: bool, names: set[str]) -> None:
    if names & {"children_left", "children_right"}:
        names |= {"children_left", "children_right"}  # one alone leaves a node without a parent
    rng = np.random.default_rng(seed)
    tree = some_tree(rng, with_basis)
    before = {name: getattr(tree, name) for name in TREE_FIELDS}
    changes = {name: other_field(tree, name, rng) for name in sorted(names)}
    if changes.get("basis") is not None:  # then P and M are of the basis, as in the constructor
        changes |= {name: getattr(tree, f"{name}_of_basis") + 1 for name in ("P", "M") if name in changes}
    changed = tree.replace(**changes)
    expected = {name: getattr(tree, name) for name in TREE_FIELDS} | changes
    if changes.get("basis") is not None:
        basis = changes["basis"]
        expected |= {name: changes.get(name, getattr(tree, f"{name}_of_basis")) @ basis for name in ("P", "M")}
    elif {"P", "M"} & names:
        expected["basis"] = None
    for name, value in expected.items():
        np.testing.assert_array_equal(getattr(changed, name), value, err_msg=name)
    for name, value in before.items():
        assert getattr(tree, name) is value


def test_what_was_changed_is_checked() -> None:
    tree = some_tree(np.random.default_rng(0), with_basis=True)
    network = make_network(np.random.default_rng(0), (3,), n_outputs=2)
    for changed, changes, error, words in (
        (tree, {"v": [0.0, np.nan]}, otr.InvalidTreeError, "v holds a number that is not finite"),
        (tree, {"head": otr.TanhBox([0.0] * 2, [1.0] * 2)}, otr.InvalidNetworkError, "limits for 2 outputs, .* has 3"),
        (tree, {"offsets": tree.c}, TypeError, "unexpected keyword argument 'offsets'"),
        (network, {"negative_slope": 1.5}, otr.InvalidNetworkError, r"negative_slope is 1\.5"),
        (network, {"head": otr.Sign()}, otr.InvalidNetworkError, "Sign needs 1 output"),
        (network, {"slope": 0.5}, TypeError, "unexpected keyword argument 'slope'"),
    ):
        with pytest.raises(error, match=words):
            changed.replace(**changes)


@given(SEEDS, st.booleans(), st.sampled_from(["identity", "argmax"]))
def test_a_tree_of_affine_features_is_a_tree_of_the_inputs(seed: int, with_basis: bool, head: str) -> None:
    rng = np.random.default_rng(seed)
    tree = some_tree(rng, with_basis).replace(labels=None, head=otr.Identity() if head == "identity" else otr.Argmax())
    A, a, X = rng.normal(size=(5, 4)), rng.normal(size=5), rng.normal(size=(50, 4))
    composed = tree.compose(A, a)
    np.testing.assert_allclose(composed.forward(X), tree.forward(X @ A.T + a), atol=1e-9)
    assert composed.head == tree.head


@given(SEEDS, st.sets(st.sampled_from(NETWORK_FIELDS)))
def test_a_network_keeps_its_other_fields(seed: int, names: set[str]) -> None:
    rng = np.random.default_rng(seed)
    plain = make_network(rng, (3, 2), n_outputs=2, dense="input", negative_slope=0.25, head="clip_box")
    network = otr.ReluNetwork(**{name: getattr(plain, name) for name in NETWORK_FIELDS} | {"domain": (-1.0, 1.0)})
    others = {
        "weights": [2 * W for W in network.weights],
        "biases": [2 * b for b in network.biases],
        "negative_slope": 0.5,
        "dense": "all",
        "head": otr.Argmax(),
        "domain": None,
    }
    if "dense" in names:
        names |= {"weights"}
        others["weights"] = make_network(rng, (3, 2), n_outputs=2, dense="all").weights
    changed = network.replace(**{name: others[name] for name in names})
    for name in NETWORK_FIELDS:
        expected = others[name] if name in names else getattr(network, name)
        if name in ("weights", "biases"):
            for ours, theirs in zip(getattr(changed, name), expected, strict=True):
                np.testing.assert_array_equal(ours, theirs)
        else:
            assert getattr(changed, name) == expected, name
