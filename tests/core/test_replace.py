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


@pytest.mark.parametrize("with_basis", [False, True])
def test_a_tree_keeps_its_other_fields(with_basis: bool) -> None:
    rng = np.random.default_rng(0)
    tree = some_tree(rng, with_basis)
    before = {name: getattr(tree, name) for name in TREE_FIELDS}
    given: list[dict[str, Any]] = [
        {"children_left": [1, ~1], "children_right": [~0, ~2]},
        {"head": otr.Argmax()},
        {"labels": (tree.labels + 1) % 3},
        *({name: before[name] + 1} for name in ("P", "v", "M", "c")),
        {},
    ]
    for changes in given:
        expected = before | changes | ({"basis": None} if {"P", "M"} & changes.keys() else {})
        changed = tree.replace(**changes)
        for name, value in expected.items():
            np.testing.assert_array_equal(getattr(changed, name), value, err_msg=name)
        assert all(getattr(tree, name) is value for name, value in before.items())
    if with_basis:  # P and M are of the basis then, as in the constructor
        basis, P = rng.normal(size=(2, 4)), tree.P_of_basis + 1
        changed = tree.replace(basis=basis, P=P)
        np.testing.assert_array_equal(changed.P, P @ basis)
        np.testing.assert_array_equal(changed.M, tree.M_of_basis @ basis)


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


@pytest.mark.parametrize("name", NETWORK_FIELDS)
def test_a_network_keeps_its_other_fields(name: str) -> None:
    rng = np.random.default_rng(0)
    options: dict[str, Any] = {"n_outputs": 2, "dense": "input", "negative_slope": 0.25, "head": "clip_box"}
    network = make_network(rng, (3, 2), **options).replace(domain=(-1.0, 1.0))
    all_links = make_network(rng, (3, 2), n_outputs=2, dense="all").weights
    others = {
        "weights": {"weights": [2 * W for W in network.weights]},
        "biases": {"biases": [2 * b for b in network.biases]},
        "negative_slope": {"negative_slope": 0.5},
        "dense": {"dense": "all", "weights": all_links},
        "head": {"head": otr.Argmax()},
        "domain": {"domain": None},
    }
    changed = network.replace(**others[name])
    for field in NETWORK_FIELDS:
        found, expected = getattr(changed, field), others[name].get(field, getattr(network, field))
        if field in ("weights", "biases"):
            assert all(np.array_equal(ours, theirs) for ours, theirs in zip(found, expected, strict=True)), field
        else:
            assert found == expected, field
